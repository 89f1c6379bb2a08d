import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from rod_world import make_scene
from scipy.spatial.transform import Rotation

from neeco.base.errors import NeecoError
from neeco.capture.model import Instrument, InstrumentState, State
from neeco.capture.readers import read_states
from neeco.capture.writer import state_to_json
from neeco.geometry.rotations import rigid
from neeco.synthesis.samplers import (
    ExtrapolatedStates,
    GridStates,
    InterpolatedStates,
    JointRange,
    OrbitViews,
    PathStates,
    PerturbedViews,
    RecordedViews,
    RolledViews,
    SimilarFrames,
    interpolate_pose,
    make_sampler,
    shafts_of,
    turn_about,
    with_poses,
)


def rng_of(index: int) -> np.random.Generator:
    return np.random.default_rng(np.random.SeedSequence([0, index]))


def random_pose(rng: np.random.Generator) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, :3] = Rotation.random(random_state=rng).as_matrix()
    pose[:3, 3] = rng.normal(size=3) * 50
    return pose


def is_rigid(pose: np.ndarray) -> bool:
    rotation = pose[:3, :3]
    return bool(np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-9) and np.linalg.det(rotation) > 0)


@given(st.integers(0, 10_000), st.floats(-0.5, 1.5))
@settings(max_examples=50, deadline=None)
def test_a_pose_between_two_is_rigid_and_reaches_both(seed, weight):
    rng = np.random.default_rng(seed)
    first, second = random_pose(rng), random_pose(rng)
    assert is_rigid(interpolate_pose(first, second, weight))
    assert np.allclose(interpolate_pose(first, second, 0.0), first)
    assert np.allclose(interpolate_pose(first, second, 1.0), second, atol=1e-7)


def test_inside_stays_inside_the_recorded_range_and_is_not_a_recorded_state(scene):
    sampler = InterpolatedStates(scene.recorded.states)
    recorded = np.stack([s.instruments["rod"].pose[:3, 3].numpy() for s in scene.recorded.states])
    drawn = [sampler(k, rng_of(k)).instruments["rod"] for k in range(60)]
    positions = np.stack([d.pose[:3, 3].numpy() for d in drawn])
    assert (positions >= recorded.min(0) - 1e-9).all()
    assert (positions <= recorded.max(0) + 1e-9).all()
    assert np.linalg.norm(positions[:, None] - recorded[None], axis=2).min() > 1e-3
    assert all(0 <= d.joints["jaw_angle"] <= 0.8 and is_rigid(d.pose.numpy()) for d in drawn)
    assert np.ptp([d.joints["jaw_angle"] for d in drawn]) > 0.6


def test_beyond_leaves_the_recorded_range_by_at_most_the_margin_and_obeys_limits(scene):
    sampler = ExtrapolatedStates(scene.recorded.states, (Instrument("rod", {"jaw_angle": (0.0, 0.9)}),), margin=0.5)
    jaws = [sampler(k, rng_of(k)).instruments["rod"].joints["jaw_angle"] for k in range(200)]
    assert min(jaws) >= 0.0  # the limit; the margin alone would allow -0.4
    assert 0.82 < max(jaws) <= 0.9
    free = ExtrapolatedStates(scene.recorded.states, (Instrument("rod", {"jaw_angle": None}),), margin=0.5)
    jaws = [free(k, rng_of(k)).instruments["rod"].joints["jaw_angle"] for k in range(200)]
    assert 0.0 <= min(jaws) < 0.1  # recorded from 0 on
    assert 1.0 < max(jaws) <= 1.2


def test_beyond_moves_poses_farther_from_the_mean(scene):
    inside = InterpolatedStates(scene.recorded.states)
    beyond = ExtrapolatedStates(scene.recorded.states, scene.instruments, 0.5)
    mean = inside.means["rod"][:3, 3]

    def reach(sampler):
        poses = (sampler(k, rng_of(k)).instruments["rod"].pose[:3, 3].numpy() for k in range(100))
        return np.mean([np.linalg.norm(p - mean) for p in poses])

    assert 1.2 < reach(beyond) / reach(inside) < 1.9


def test_a_margin_of_nothing_is_refused(scene):
    with pytest.raises(NeecoError, match="--margin"):
        ExtrapolatedStates(scene.recorded.states, scene.instruments, 0.0)


@pytest.mark.parametrize(
    ("recorded", "widened"),
    [
        ((0.0, 1.0), (0.0, 1.2)),
        ((0.1, 1.1), (0.0, 1.3)),
        ((-0.04, 0.96), (-0.04, 1.16)),
        ((-1.0, 0.02), (-1.204, 0.02)),
        ((-0.5, 0.5), (-0.7, 0.7)),
        ((0.3, 0.4), (0.28, 0.42)),
    ],
)
def test_jaws_that_were_recorded_closed_do_not_cross(recorded, widened):
    found = JointRange(*recorded).widened(0.2, None)
    assert (found.lower, found.upper) == pytest.approx(widened)


def test_limits_narrower_than_the_recording_do_not_cut_into_it():
    assert JointRange(0.0, 1.0).widened(0.2, (0.1, 0.9)) == JointRange(0.0, 1.0)


def test_the_grid_holds_every_joint_value_with_every_roll_about_the_shaft(scene):
    shafts = shafts_of(scene)
    assert np.allclose(shafts["rod"].along, [0, 1, 0])
    sampler = GridStates(scene.recorded.states, shafts, joint_values=3, rolls=4)
    states = [sampler(k, rng_of(k)).instruments["rod"] for k in range(12)]
    assert {round(s.joints["jaw_angle"], 6) for s in states} == {0.0, 0.4, 0.8}
    directions = np.stack([s.pose[:3, 1].numpy() for s in states])
    assert np.allclose(directions, directions[0])  # rolling keeps the shaft
    assert len({tuple(np.round(s.pose[:3, 0].numpy(), 6)) for s in states}) == 4


def test_a_path_passes_through_its_key_states(state):
    keys = [state(x=0.0, jaw=0.0), state(x=10.0, jaw=0.4), state(x=10.0, y=5.0, jaw=0.8)]
    path = PathStates(keys, count=5)
    drawn = [path(k, rng_of(k)).instruments["rod"] for k in range(5)]
    assert [d.joints["jaw_angle"] for d in drawn] == pytest.approx([0, 0.2, 0.4, 0.6, 0.8])
    assert drawn[1].pose[0, 3] == pytest.approx(5.0)
    with pytest.raises(NeecoError, match="two"):
        PathStates(keys[:1], 5)


def test_states_written_are_states_read(tmp_path, scene, state):
    path = tmp_path / "states.jsonl"
    first, second = state(x=3.0, jaw=0.5), state(y=2.0)
    camera = np.diag([1.0, -1.0, -1.0, 1.0]).tolist()  # OpenGL axes of an OpenCV camera at the world's origin
    lines = [state_to_json(first), state_to_json(second) | {"camera": camera}]
    path.write_text("".join(json.dumps(line) + "\n" for line in lines))
    read = read_states(path, scene.instruments)
    assert read[0].state.instruments["rod"].joints == {"jaw_angle": 0.5}
    assert (read[0].state.instruments["rod"].pose == first.instruments["rod"].pose).all()
    assert read[0].world_from_camera is None
    assert np.allclose(read[1].world_from_camera, np.eye(4))


@pytest.mark.parametrize(
    ("change", "field"),
    [
        (lambda line: line["instruments"][0].update(name="hook"), r"instruments\[0\].name"),
        (lambda line: line["instruments"][0]["pose"][0].__setitem__(0, 2.0), r"instruments\[0\].pose"),
        (lambda line: line["instruments"][0]["pose"][0].__setitem__(3, float("nan")), r"instruments\[0\].pose"),
        (lambda line: line["instruments"][0]["pose"][0].pop(), r"instruments\[0\].pose"),
        (lambda line: line["instruments"][0]["joints"].update(jaw_angle=2.0), "joints.jaw_angle.*limits"),
        (lambda line: line["instruments"][0]["joints"].clear(), r"instruments\[0\].joints"),
        (lambda line: line["instruments"][0]["joints"].update(jaw=0.1), "joints.jaw: is no joint of rod; it has jaw"),
        (lambda line: line["instruments"][0]["joints"].update(jaw_angle=float("nan")), "joints.jaw_angle: is nan"),
        (lambda line: line["instruments"].clear(), "rod missing"),
        (lambda line: line.pop("instruments"), "instruments"),
        (lambda line: line.update(camera=[[1]]), "camera"),
        (lambda line: line.update(time="now"), "time"),
        (lambda line: line.update(time=10**400), "time: is a huge integer, not a finite number"),
        (lambda line: line["instruments"][0]["pose"][0].__setitem__(3, 10**400), r"instruments\[0\].pose"),
        (lambda line: line["instruments"][0].update(name=["rod"]), r"instruments\[0\].name: \['rod'\] is not"),
        (
            lambda line: line["instruments"].append(line["instruments"][0]),
            r"instruments\[1\].name: 'rod' is listed twice",
        ),
    ],
)
def test_a_bad_state_is_refused_with_its_line_and_field(tmp_path, scene, state, change, field):
    path = tmp_path / "states.jsonl"
    bad = state_to_json(state())
    change(bad)
    path.write_text(json.dumps(state_to_json(state())) + "\n" + json.dumps(bad) + "\n")
    with pytest.raises(NeecoError, match=f"states.jsonl: line 2: .*{field}") as caught:
        read_states(path, scene.instruments)
    assert "\n" not in str(caught.value)


def test_a_misspelt_sampler_is_refused_by_name(scene):
    with pytest.raises(NeecoError, match="'interpol' is neither interpolate, extrapolate"):
        make_sampler(scene, "interpol", 0.2, "recorded", 1)


def test_an_orbit_keeps_its_centre_at_its_place_and_distance(camera):
    centre = np.array([5.0, -3.0, 100.0])
    views = OrbitViews(RecordedViews((camera,)), centre, degrees=30)
    for k in range(10):
        moved = views(State(), rng_of(k)).world_from_camera.numpy()
        assert is_rigid(moved)
        assert np.allclose((np.linalg.inv(moved) @ np.append(centre, 1))[:3], centre)
    assert not np.allclose(moved, np.eye(4), atol=1e-3)


def test_rolled_views_turn_the_image_about_its_principal_point_by_all_angles(camera):
    views, ahead = RolledViews(RecordedViews((camera,))), np.array([0.0, 0.0, 100.0, 1.0])
    angles = []
    for k in range(400):
        moved = views(State(), rng_of(k)).world_from_camera.numpy()
        assert is_rigid(moved)
        assert np.allclose(moved @ ahead, camera.world_from_camera.numpy() @ ahead, atol=1e-4)
        angles.append(np.arctan2(moved[1, 0], moved[0, 0]))
    assert np.histogram(angles, 8, (-np.pi, np.pi))[0].min() > 25


def test_perturbed_views_stay_near_recorded_ones(camera):
    views = PerturbedViews(RecordedViews((camera,)), degrees=2.0, mm=1.0)
    shifts = [np.linalg.norm(views(State(), rng_of(k)).world_from_camera.numpy()[:3, 3]) for k in range(100)]
    assert 0 < np.mean(shifts) < 3
    assert views(State(), rng_of(0)).fx == camera.fx


def standing_at(x: float, turn: float = 0.0, jaw: float = 0.0) -> State:
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3] = torch.from_numpy(Rotation.from_rotvec([0.0, 0.0, turn]).as_matrix())
    pose[0, 3] = x
    return State({"tool": InstrumentState(pose, {"jaw": jaw})})


def test_a_state_is_seen_by_cameras_that_recorded_like_ones_whatever_its_joints(camera):
    count = 5 * SimilarFrames.n_similar
    cameras = [replace(camera, fx=float(k + 1)) for k in range(count)]
    views = RecordedViews(cameras, [standing_at(float(k), 0.01 * k, jaw=float(k % 2)) for k in range(count)])
    chosen = {int(views(standing_at(count / 2 + 0.3, 0.005 * count, jaw=9.0), rng_of(k)).fx) - 1 for k in range(200)}
    assert len(chosen) == SimilarFrames.n_similar
    assert max(abs(k - count / 2) for k in chosen) <= SimilarFrames.n_similar / 2 + 1


def test_without_like_states_any_recorded_camera_may_see_a_state(camera):
    cameras = [replace(camera, fx=float(k + 1)) for k in range(3 * SimilarFrames.n_similar)]
    other = State({"other": standing_at(0.0).instruments["tool"]})
    known = [standing_at(float(k)) for k in range(len(cameras))]
    for views, state in (
        (RecordedViews(cameras), standing_at(0.0)),  # no states are known
        (RecordedViews(cameras, [standing_at(1.0)] * len(cameras)), standing_at(0.0)),  # nothing moved
        (RecordedViews(cameras, known), other),  # of another instrument
    ):
        assert len({views(state, rng_of(k)).fx for k in range(400)}) == len(cameras)


@pytest.mark.parametrize("states", ["", "path:", "."])
def test_a_folder_is_no_file_of_states(scene, states):
    with pytest.raises(NeecoError, match=f"--states: '{states}' is neither interpolate, extrapolate"):
        make_sampler(scene, states, 0.2, "recorded", 1)


def test_a_turn_about_a_point_leaves_it_where_it_is_and_turns_the_rest():
    point, quarter = np.array([5.0, -2.0, 60.0]), np.array([0.0, 0.0, np.pi / 2])
    turn = turn_about(point, quarter)
    assert turn @ np.append(point, 1) == pytest.approx(np.append(point, 1))
    beside, above = np.array([1.0, 0.0, 3.0]), np.array([0.0, 1.0, 3.0])
    assert turn @ np.append(point + beside, 1) == pytest.approx(np.append(point + above, 1))


def test_poses_are_moved_one_by_one_and_joints_and_time_are_kept(state):
    posed = state()
    shifted = with_poses(posed, lambda name, pose: rigid(np.eye(3), pose[:3, 3] + 1))
    for name, item in posed.instruments.items():
        assert torch.equal(shifted.instruments[name].pose[:3, 3], item.pose[:3, 3].double() + 1)
        assert shifted.instruments[name].joints == item.joints
    assert shifted.time == posed.time


def test_views_of_a_still_scope_stay_near_what_it_saw():
    scene = make_scene()
    scene.recorded = replace(scene.recorded, still=True)
    sampler = make_sampler(scene, "interpolate", 0.2, "perturbed", 1)
    rng = np.random.default_rng(0)
    places = np.stack([camera.world_from_camera[:3, 3].numpy() for camera in scene.recorded.cameras])
    for state in scene.recorded.states[:10]:
        place = sampler.views(state, rng).world_from_camera[:3, 3].numpy()
        assert np.linalg.norm(places - place, axis=1).min() < 5
    with pytest.raises(NeecoError, match="--views orbit: the scope was still"):
        make_sampler(scene, "interpolate", 0.2, "orbit", 1)
