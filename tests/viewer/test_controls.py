"""What sliders say becomes a state."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scene_worlds import GRASPER, make_nerf, make_scene, pose_of
from scipy.spatial.transform import Rotation
from viewer_world import LIMITS, grasper_scene

from neeco.capture.model import Instrument, InstrumentState, State
from neeco.synthesis.samplers import Shaft, shafts_of
from neeco.viewer.views import Controls, InstrumentControls, controlled_state, interpolated_state, slider_ranges

NAME = "grasper"
TILTED = Shaft(np.array([1.0, 2.0, 3.0]), np.array([0.6, 0.0, 0.8]), True)


def two_states() -> tuple[State, State]:
    start, end = pose_of(0, 0, 0, 0, 0, 0), pose_of(0, 0, 1.0, 10, 0, 0)
    return (
        State({NAME: InstrumentState(start, {"jaw_angle": 0.2})}, 1.0),
        State({NAME: InstrumentState(end, {"jaw_angle": 0.6})}, 2.0),
    )


def steered(frame: float = 0.0, **controls) -> tuple[np.ndarray, dict[str, float]]:
    state = controlled_state(two_states(), {NAME: TILTED}, Controls(frame, {NAME: InstrumentControls(**controls)}))
    return state.instruments[NAME].pose.numpy(), dict(state.instruments[NAME].joints)


def test_a_recorded_frame_is_itself() -> None:
    states = two_states()
    state = controlled_state(states, {NAME: TILTED}, Controls(1.0, {NAME: InstrumentControls()}))
    assert state.instruments[NAME] is states[1].instruments[NAME]
    assert state.time == states[1].time


def test_half_way_between_two_frames_everything_is_half_way() -> None:
    state = interpolated_state(two_states(), 0.5)
    pose = state.instruments[NAME].pose.numpy()
    assert pose[:3, 3] == pytest.approx([5, 0, 0])
    assert Rotation.from_matrix(pose[:3, :3]).as_rotvec() == pytest.approx([0, 0, 0.5])
    assert state.instruments[NAME].joints["jaw_angle"] == pytest.approx(0.4)
    assert state.time == pytest.approx(1.5)


def test_sliding_goes_along_the_shaft_and_turns_nothing() -> None:
    pose, joints = steered(slide=5.0)
    assert pose[:3, 3] == pytest.approx([3, 0, 4])
    assert pose[:3, :3] == pytest.approx(np.eye(3))
    assert joints == {"jaw_angle": 0.2}


def test_rolling_leaves_every_point_of_the_shaft_where_it_is() -> None:
    pose, _ = steered(roll=1.0)
    for far in (-20.0, 0.0, 8.0):
        point = TILTED.end + far * TILTED.along
        assert pose[:3, :3] @ point + pose[:3, 3] == pytest.approx(point)
    assert Rotation.from_matrix(pose[:3, :3]).magnitude() == pytest.approx(1.0)


@pytest.mark.parametrize("turn", ["yaw", "pitch"])
def test_yaw_and_pitch_leave_the_shafts_end_where_it_is_and_tilt_the_rest(turn: str) -> None:
    pose, _ = steered(**{turn: 0.3})
    assert pose[:3, :3] @ TILTED.end + pose[:3, 3] == pytest.approx(TILTED.end)
    assert math.acos(TILTED.along @ pose[:3, :3] @ TILTED.along) == pytest.approx(0.3)


def test_yaw_and_pitch_go_to_different_sides() -> None:
    aside = [steered(**{turn: 0.3})[0][:3, :3] @ TILTED.along - TILTED.along for turn in ("yaw", "pitch")]
    assert abs(aside[0] @ aside[1]) < 0.01 < np.linalg.norm(aside[0]) * np.linalg.norm(aside[1])


def test_turned_it_still_slides_along_where_it_pointed() -> None:
    straight, turned = steered(yaw=0.3)[0], steered(yaw=0.3, slide=5.0)[0]
    assert turned[:3, 3] - straight[:3, 3] == pytest.approx(5 * TILTED.along)


def test_a_given_pose_stands_instead_of_the_recorded_and_the_rest_adds_to_it() -> None:
    given = pose_of(0.1, 0.2, 0.3, 7, 8, 9).numpy()
    assert steered(pose=given)[0] == pytest.approx(given)
    assert steered(pose=given, slide=5.0)[0][:3, 3] == pytest.approx(given[:3, 3] + 5 * given[:3, :3] @ TILTED.along)


def test_joints_that_are_not_named_stay_as_recorded() -> None:
    state = State({NAME: InstrumentState(pose_of(0, 0, 0, 0, 0, 0), {"a": 0.1, "b": 0.2})})
    controls = Controls(0.0, {NAME: InstrumentControls(joints={"b": 0.9})})
    assert controlled_state([state], {NAME: TILTED}, controls).instruments[NAME].joints == {"a": 0.1, "b": 0.9}


def test_steered_poses_are_rigid() -> None:
    pose, _ = steered(0.3, slide=3.0, roll=2.0, yaw=-0.4, pitch=0.7)
    assert pose[:3, :3] @ pose[:3, :3].T == pytest.approx(np.eye(3), abs=1e-12)
    assert np.linalg.det(pose[:3, :3]) == pytest.approx(1.0)
    assert pose[3].tolist() == [0, 0, 0, 1]


@pytest.mark.parametrize(
    ("controls", "frame"),
    [
        (Controls(3.0), 3),
        (Controls(3.5), None),
        (Controls(3.0, {NAME: InstrumentControls()}), 3),
        (Controls(3.0, {NAME: InstrumentControls(roll=0.1)}), None),
        (Controls(3.0, {NAME: InstrumentControls(joints={"jaw_angle": 0.2})}), None),
        (Controls(3.0, {NAME: InstrumentControls(pose=np.eye(4))}), None),
    ],
)
def test_only_an_unsteered_frame_is_recorded(controls: Controls, frame: int | None) -> None:
    assert controls.recorded_frame == frame


def test_a_field_is_steered_by_time_alone() -> None:
    scene = make_nerf()
    assert not shafts_of(scene)["rod"].learned
    assert controlled_state(scene.recorded.states, shafts_of(scene), Controls(1.5)).time == pytest.approx(2.0)


def test_a_learned_shaft_is_the_one_that_is_drawn() -> None:
    scene = grasper_scene()
    shaft = shafts_of(scene)[NAME]
    assert shaft.learned
    assert shaft.along == pytest.approx([0, 0, 1], abs=1e-5)
    assert shaft.end[:2] == pytest.approx([0, 0], abs=1e-4)


def test_without_a_learned_shaft_it_is_the_tracked_frames_z_axis() -> None:
    shaft = shafts_of(make_scene("deformable-3dgs"))[GRASPER.name]
    assert not shaft.learned
    assert shaft.along.tolist() == [0, 0, 1]


def test_sliders_go_to_the_limits_that_the_capture_states() -> None:
    scene = grasper_scene()
    span = slider_ranges(scene.instruments, scene.recorded.states)[NAME, "jaw_angle"]
    assert (span.lower, span.upper) == LIMITS


@pytest.mark.parametrize("limits", [None, (math.nan, 1.0), (1.0, 1.0), (-math.inf, math.inf)])
def test_where_limits_say_nothing_sliders_go_a_little_beyond_what_was_recorded(limits):
    instruments = (Instrument(NAME, {"jaw_angle": limits}),)
    span = slider_ranges(instruments, two_states())[NAME, "jaw_angle"]
    assert span.lower == pytest.approx(0.2 - 0.08)
    assert span.upper == pytest.approx(0.6 + 0.08)


def test_a_joint_that_never_moved_still_has_a_range() -> None:
    still = (two_states()[0],) * 3
    span = slider_ranges((Instrument(NAME, {"jaw_angle": None}),), still)[NAME, "jaw_angle"]
    assert span.lower < 0.2 < span.upper
