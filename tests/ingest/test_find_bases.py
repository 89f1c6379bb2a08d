"""The bases of a recording's instruments, from its logs: stated exactly, or found and described."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from ingest.base_world import (
    FOCAL,
    HEIGHT,
    INTRINSICS,
    WIDTH,
    WORLD_FROM_BASE,
    disturbed,
    episodes,
    errors,
    make_world,
    rigid,
    silent,
    views_of,
)
from scipy.spatial.transform import Rotation

from neeco.base.errors import NeecoError
from neeco.capture.kinematics import REVOLUTE, KinematicTree, Link
from neeco.geometry.lens import Lens
from neeco.ingest.readers.logs import PoseLog, ReadingLog
from neeco.ingest.recording.base import StatedBase
from neeco.ingest.recording.model import InstrumentLogs, JointColumns
from neeco.ingest.registration import find_bases as module
from neeco.ingest.registration.base import BaseRegistration, in_camera
from neeco.ingest.registration.find_bases import correct_placement, find_bases, follow_cameras
from neeco.ingest.registration.hand_eye import Registration
from neeco.ingest.timing.clock_search import GIVEN, VIDEOS_OWN, ClockOffset

LENS = Lens(FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2, (), (WIDTH, HEIGHT))
STILL = np.tile(np.eye(4), (44, 1, 1))


def _data(world, base, clocks=None):
    """An episode of one arm whose log begins before the video."""
    times = np.arange(-0.4, world.times[-1] + 0.4, 0.02)
    poses = type(world)(world.masks, world.camera_from_world, times, False).poses_at(0.0)
    quats = Rotation.from_matrix(poses[:, :3, :3]).as_quat()[:, [3, 0, 1, 2]]
    log = PoseLog(path=None, clock="ros", times=times, positions=poses[:, :3, 3], quats=quats, gaps=(), notes=())
    return episodes([InstrumentLogs(name="psm1", camera_from_base=base)], {"psm1": log}, clocks or {})


def _black(world, cameras=STILL):
    black = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    return views_of(world.times, cameras, LENS, lambda row: black)


def _no_masks(rows):
    pytest.fail("an exact base needs no masks")


def test_an_exact_base_is_taken_as_it_is():
    world = make_world(44)
    data = _data(world, StatedBase(WORLD_FROM_BASE))
    placed, found = find_bases(data, _black(world), _no_masks, silent)
    assert np.array_equal(placed.world_from_base["psm1"], WORLD_FROM_BASE)
    assert placed.clock("ros") is None
    assert found == {}


def test_an_arm_that_says_nothing_of_its_base_is_left_alone():
    world = make_world(44)
    placed, _ = find_bases(_data(world, None), _black(world), _no_masks, silent)
    assert placed.world_from_base == {}


@pytest.mark.slow
def test_a_rough_base_is_found_with_its_clock_and_told_in_a_note():
    world = make_world(44)
    data = _data(world, StatedBase(disturbed(8, 5, 1, world), 5.0, 3.0))
    placed, _ = find_bases(data, _black(world), lambda rows: world.masks[rows], silent)
    assert errors(placed.world_from_base["psm1"], world.poses_at(0.0))[0] < 1.3
    assert placed.clock("ros").source == "found with the base"
    assert abs(placed.clock("ros").seconds - 0.03) < min(0.013, 2 * placed.clock("ros").sd)
    assert "its base was found from what moves in 44 frames" in data.notes.sentences[0]
    assert "mm and" in data.notes.sentences[0]


@pytest.mark.parametrize(("moving", "key"), [(False, "camera_from_base"), (True, "world_from_base")])
def test_what_shows_no_shaft_names_the_recording_and_the_key_that_states_the_base(moving, key):
    world = make_world(44, moving_camera=moving)
    data = _data(world, StatedBase(to_world=moving))
    views = _black(world, np.linalg.inv(world.camera_from_world))
    with pytest.raises(
        NeecoError, match=rf"^recording\.yaml: instrument 'psm1': {key}: what moves looks like a shaft in"
    ):
        find_bases(data, views, lambda rows: np.zeros((len(rows), HEIGHT, WIDTH), bool), silent)
    assert LENS.intrinsics == INTRINSICS


@pytest.mark.slow
def test_a_log_on_the_videos_own_clock_keeps_it_while_its_base_is_found():
    world = make_world(44)
    own = ClockOffset(0.03, 0.0, VIDEOS_OWN)
    data = _data(world, StatedBase(disturbed(8, 5, 1, world), 5.0, 3.0), {"ros": own})
    placed, _ = find_bases(data, _black(world), lambda rows: world.masks[rows], silent)
    assert placed.clock("ros") == own


@pytest.mark.slow
def test_a_rough_base_is_found_before_a_scope_that_moves():
    world = make_world(44, moving_camera=True)
    data = _data(world, StatedBase(disturbed(8, 5, 1, world), 5.0, 3.0, to_world=True))
    cameras = np.linalg.inv(world.camera_from_world)
    placed, _ = find_bases(data, _black(world, cameras), lambda rows: world.masks[rows], silent)
    assert errors(placed.world_from_base["psm1"], world.poses_at(0.0))[0] < 1.2  # of 3.5 s in all


def _hand_eye(origin, sd_mm, sd_deg):
    """A hand-eye calibration that is known so well along and about each axis."""
    variances = np.square([0.005, *[np.radians(sd_deg)] * 3, *[sd_mm] * 3])
    return Registration(
        scale=1.0, rotation=np.eye(3), translation=np.zeros(3), camera_from_sensor=np.eye(4),
        clock=ClockOffset(0.0, 0.0, GIVEN), scale_sd=0.005, origin=origin,
        covariances=np.stack([np.diag(variances)] * 2), position_residual=np.zeros(44),
        rotation_residual=np.zeros(44), used=np.arange(44),
    )  # fmt: skip


def _placed(masks, beside, sd_mm, sd_deg):
    """What `correct_placement` makes of an instrument that a hand-eye calibration places `beside` [4, 4] its own."""
    world = make_world(44, moving_camera=True)
    data = _data(world, None, {"ros": ClockOffset(0.03, 0.0, GIVEN)})
    log = data.parts[0].poses["psm1"]
    poses = np.tile(np.eye(4), (len(log.times), 1, 1))
    poses[:, :3, :3] = Rotation.from_quat(log.quats, scalar_first=True).as_matrix()
    poses[:, :3, 3] = log.positions
    poses = beside @ poses
    quats = Rotation.from_matrix(poses[:, :3, :3]).as_quat(scalar_first=True)
    log = replace(log, positions=poses[:, :3, 3], quats=quats)
    data = replace(data, parts=(replace(data.parts[0], poses={"psm1": log}),))
    registration = _hand_eye(poses[:, :3, 3].mean(0), sd_mm / 3**0.5, sd_deg / 3**0.5)
    views = _black(world, np.linalg.inv(world.camera_from_world))
    placed, found = correct_placement(data, views, registration, masks, silent)
    corrected = placed.world_from_base.get("psm1", np.eye(4)) @ beside
    return errors(corrected, world.poses_at(0.0)), errors(beside, world.poses_at(0.0)), found, data.notes.sentences


def test_a_base_is_as_far_off_among_misplaced_cameras_as_it_states(monkeypatch):
    """The images show a base among the cameras, but not along its shaft nor about it: there it stays as stated to the
    tracker, in whose frame a hand-eye calibration placed all cameras with one error."""
    world, generator = make_world(14, moving_camera=True), np.random.default_rng(0)
    poses = world.poses_at(0.0)
    middle = poses[:, :3, 3].mean(0)  # in the base
    at = (WORLD_FROM_BASE @ np.append(middle, 1.0))[:3]
    shaft = (WORLD_FROM_BASE[:3, :3] @ poses[:, :3, 2].mean(0)) / np.linalg.norm(poses[:, :3, 2].mean(0))
    across = np.eye(3) - np.outer(shaft, shaft)
    seen = np.kron(np.diag([np.radians(0.3) ** -2, 0.3**-2]), across)  # information, of turns and shifts

    def moved(base, step):
        turn = rigid(tuple(step[:3]), (0.0, 0.0, 0.0))
        turn[:3, 3] = at + step[3:] - turn[:3, :3] @ at
        return turn @ base

    def step(first, second):
        turn = Rotation.from_matrix(second[:3, :3] @ first[:3, :3].T).as_rotvec()
        return np.append(turn, (second - first)[:3] @ np.append(middle, 1.0))

    def find(masks, intrinsics, camera_from_world, motion, prior, **others):
        base = np.linalg.inv(camera_from_world[0]) @ world.camera_from_world[0] @ WORLD_FROM_BASE
        shown = seen @ generator.multivariate_normal(np.zeros(6), np.linalg.pinv(seen))
        known = np.diag(np.repeat([np.radians(prior[2]) ** -2, prior[1] ** -2], 3))
        covariance = np.linalg.inv(seen + known)
        return BaseRegistration(
            world_from_base=moved(base, covariance @ (shown + known @ step(base, prior[0]))), clock_s=0.0,
            clock_sd_s=0.0, covariance=in_camera(covariance, camera_from_world[0]), open_directions=(), frames=14,
        )  # fmt: skip

    monkeypatch.setattr(module, "find_base", find)
    registration, off = _hand_eye(at, 3.0, 1.5), []
    logged = _data(world, None, {"ros": ClockOffset(0.03, 0.0, GIVEN)})
    (part,) = logged.parts
    for _ in range(40):
        error = generator.normal(size=6) * np.repeat([np.radians(1.5), 3.0], 3)
        stated = generator.normal(size=6) * np.repeat([np.radians(1.0), 1.5], 3)
        base, cameras = moved(WORLD_FROM_BASE, stated), moved(np.linalg.inv(world.camera_from_world), error)
        items = (InstrumentLogs(name="psm1", world_from_base=StatedBase(base, 1.5, 1.0, to_world=True)),)
        data = replace(logged, parts=(replace(part, recording=replace(part.recording, instruments=items)),))
        _, found = find_bases(data, _black(world, cameras), lambda rows: world.masks[rows], silent, registration)
        beside = step(moved(WORLD_FROM_BASE, error), found["psm1"].world_from_base)
        covariance = np.array(found["psm1"].uncertainty(cameras[0], poses).covariance)
        off.append(np.linalg.solve(np.linalg.cholesky(covariance), beside))
    assert 0.85 < np.sqrt(np.square(off).mean()) < 1.15


def test_a_base_found_among_cameras_stays_there_when_these_are_placed_again():
    world = make_world(14, moving_camera=True)
    data = _data(world, None, {"ros": ClockOffset(0.03, 0.0, GIVEN)}).with_base("psm1", WORLD_FROM_BASE)
    base = BaseRegistration(
        world_from_base=WORLD_FROM_BASE, clock_s=0.0, clock_sd_s=0.0, covariance=np.eye(6), open_directions=(),
        frames=14,
    )  # fmt: skip
    before = _black(world, np.linalg.inv(world.camera_from_world))
    again = rigid((0.02, -0.01, 0.03), (2.0, -1.0, 3.0)) @ before.world_from_camera
    after = replace(before, world_from_camera=again[2:], times=before.times[2:], frames=before.frames[2:])
    placed, found = follow_cameras(data, {"psm1": base}, before, after)
    beside = [
        np.linalg.inv(views.world_from_camera) @ of.instrument_poses("psm1", views.times)[0]
        for of, views in ((data, replace(after, world_from_camera=before.world_from_camera[2:])), (placed, after))
    ]
    np.testing.assert_allclose(*beside, atol=1e-6)
    assert np.array_equal(found["psm1"].world_from_base, placed.world_from_base["psm1"])


@pytest.mark.slow
def test_an_instrument_that_a_poor_hand_eye_calibration_places_beside_its_images_is_moved_there():
    world = make_world(44, moving_camera=True)
    after, before, found, notes = _placed(lambda rows: world.masks[rows], disturbed(4.0, 2.0, 4, world), 4.0, 2.0)
    assert after[0] < 0.5 * before[0]
    assert found["psm1"].sd_motion_mm < 1.5
    assert "'psm1': its place was corrected by" in notes[0]


@pytest.mark.slow
def test_a_poor_hand_eye_calibration_that_happens_to_be_right_is_kept():
    world = make_world(44, moving_camera=True)
    after, before, found, _ = _placed(lambda rows: world.masks[rows], WORLD_FROM_BASE, 3.0, 1.5)
    assert found == {}
    assert after == before


def test_a_usual_hand_eye_calibration_is_kept_without_looking():
    world = make_world(44, moving_camera=True)
    assert _placed(_no_masks, disturbed(0.5, 0.2, 1, world), 0.5, 0.2)[2] == {}


def test_outlines_are_not_asked_for_a_place_of_which_nearly_nothing_is_known():
    assert _placed(_no_masks, WORLD_FROM_BASE, 30.0, 10.0)[2] == {}


def test_a_poor_hand_eye_calibration_is_kept_where_images_show_no_shaft():
    world = make_world(44, moving_camera=True)
    assert _placed(lambda rows: np.zeros_like(world.masks[rows]), WORLD_FROM_BASE, 3.0, 1.5)[2] == {}


@pytest.mark.parametrize(("overlap", "doubts", "corrected"), [(0.9, (), True), (0.82, (), False), (0.9, ("?",), False)])
def test_a_place_is_corrected_only_where_images_fit_clearly_better(monkeypatch, overlap, doubts, corrected):
    world, moved = make_world(44, moving_camera=True), np.eye(4)
    moved[:3, 3] = [1.0, 2.0, 3.0]

    def find(masks, intrinsics, camera_from_world, motion, prior, **others):
        assert np.array_equal(prior[0], np.eye(4))
        assert prior[1:] == pytest.approx((3.0 / 3**0.5, 1.5 / 3**0.5), rel=0.01)  # along each axis
        assert others["clock_known"]
        return BaseRegistration(
            world_from_base=moved, clock_s=0.0, clock_sd_s=0.0, covariance=np.eye(6), open_directions=(),
            overlap=overlap, overlap_before=0.6, frames=44, doubts=doubts,
        )  # fmt: skip

    monkeypatch.setattr(module, "find_base", find)
    after, _, found, notes = _placed(lambda rows: world.masks[rows], WORLD_FROM_BASE, 3.0, 1.5)
    assert ("psm1" in found) is (len(notes) == 1) is corrected
    assert (after[1] > 1) is corrected
    assert all(item.tracked for item in found.values())


def test_a_base_stated_to_the_world_is_not_taken_for_one_to_the_camera():
    world = make_world(44, moving_camera=True)
    data = _data(world, StatedBase(WORLD_FROM_BASE, to_world=True))
    placed, _ = find_bases(data, _black(world, np.linalg.inv(world.camera_from_world)), _no_masks, silent)
    assert np.array_equal(placed.world_from_base["psm1"], WORLD_FROM_BASE)


def test_the_pose_of_a_tip_is_turned_into_the_shafts_with_readings_of_the_same_moment(monkeypatch):
    """At every clock that is tried, and where the joint's log begins later than the video: no frame of the tip is ever
    taken for one of the shaft."""
    world = make_world(44)
    tree = KinematicTree(
        (Link("shaft"), Link("tip", "shaft", REVOLUTE, np.eye(4), np.array([0.0, 1.0, 0.0]), {"yaw": 1.0})), "tip"
    )
    data = _data(world, StatedBase())
    part = data.parts[0]
    log = part.poses["psm1"]
    yaw = 0.8 * np.sin(3 * log.times)
    tips = Rotation.from_quat(log.quats[:, [1, 2, 3, 0]]) * Rotation.from_rotvec(yaw[:, None] * [0.0, 1.0, 0.0])
    late = log.times > 0.5
    joint = ReadingLog(Path("yaw.csv"), "encoder", log.times[late], yaw[late])
    item = InstrumentLogs(
        name="psm1",
        camera_from_base=StatedBase(),
        kinematics=tree,
        joints={"yaw": JointColumns(Path("yaw.csv"), "encoder")},
    )
    part = replace(
        part,
        poses={"psm1": replace(log, quats=tips.as_quat()[:, [3, 0, 1, 2]])},
        joints={"psm1": {"yaw": joint}},
        recording=replace(part.recording, instruments=(item,)),
    )
    seen = {}

    def find(masks, intrinsics, camera_from_world, motion, prior, **others):
        assert prior is None
        seen.update(poses_at=motion.poses_at, readings_at=motion.readings_at)
        return BaseRegistration(
            world_from_base=WORLD_FROM_BASE, clock_s=0.03, clock_sd_s=0.005, covariance=np.eye(6), open_directions=(),
            frames=44,
        )  # fmt: skip

    monkeypatch.setattr(module, "find_base", find)
    placed, _ = find_bases(replace(data, parts=(part,)), _black(world), lambda rows: world.masks[rows], silent)
    assert placed.clock("encoder").seconds == placed.clock("ros").seconds == 0.03  # as the readings were moved
    for shift in (0.0, 0.04):
        found, expected = seen["poses_at"](shift), world.poses_at(shift)
        known = np.isfinite(found).all((1, 2))
        assert (known == (world.times + shift >= joint.times[0])).all()
        assert np.abs(found[known] - expected[known]).max() < 0.05
    read = seen["readings_at"](0.0)["yaw"]  # frames without a reading are left out, not the joint
    assert read.shape == (44,)
    assert 20 < np.isfinite(read).sum() < 44
