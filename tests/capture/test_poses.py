"""One idea of a rigid pose and of a joint's limits, wherever a state is read."""

from __future__ import annotations

import json

import numpy as np
import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from neeco.base.errors import NeecoError
from neeco.capture import check_capture, errors_only, read_capture
from neeco.capture.readers import read_states
from neeco.capture.writer import camera_to_json
from neeco.geometry.conventions import swap_camera_axes
from neeco.geometry.rotations import RIGID_TOLERANCE, rigid_fault, rotation_error

once_a_folder = settings(
    max_examples=20, deadline=None, derandomize=True, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
small = st.floats(-2 * RIGID_TOLERANCE, 2 * RIGID_TOLERANCE)


def states_accept(folder, state: dict) -> bool:
    """Whether `--states` takes an instrument's state as the capture's own."""
    path = folder.root / "states.jsonl"
    path.write_text(json.dumps({"instruments": [state]}) + "\n")
    try:
        read_states(path, read_capture(folder.root).instruments)
    except NeecoError:
        return False
    return True


@once_a_folder
@given(st.lists(small, min_size=9, max_size=9), st.lists(small, min_size=3, max_size=3), st.booleans())
@example([RIGID_TOLERANCE * 0.45] + [0.0] * 8, [0.0] * 3, False)  # between what check and --states once allowed
@example([0.0] * 9, [0.0] * 3, True)
def test_a_pose_that_check_accepts_is_accepted_as_a_state(pristine, off, turn, three_rows):
    folder, original = pristine
    document = json.loads(json.dumps(original))
    state = document["frames"][3]["instruments"][0]
    pose = np.array(state["pose"])
    pose[:3, :3] = Rotation.from_rotvec(turn).as_matrix() @ pose[:3, :3] + np.reshape(off, (3, 3))
    state["pose"] = pose.tolist()[: 3 if three_rows else 4]
    folder.write(document)
    refused = [problem for problem in errors_only(check_capture(folder.root)) if "rigid" in problem.message]
    if refused:
        with pytest.raises(NeecoError, match="rigid"):
            read_capture(folder.root)
        folder.write(original)  # which instruments there are
    assert states_accept(folder, state) != bool(refused)


@once_a_folder
@given(st.floats(-3e-3, 3e-3))
def test_a_joint_value_that_check_accepts_is_accepted_as_a_state(pristine, beyond):
    folder, original = pristine
    document = json.loads(json.dumps(original))
    limits = document["instruments"][0]["joints"]["jaw_angle"]["limits"]
    state = document["frames"][3]["instruments"][0]
    state["joints"]["jaw_angle"] = limits[1] + beyond
    folder.write(document)
    accepted = not any("outside its limits" in problem.message for problem in check_capture(folder.root))
    assert states_accept(folder, state) == accepted


def test_a_rotation_is_rigid_and_what_is_none_is_told_why():
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_rotvec([0.3, -0.2, 0.9]).as_matrix()
    assert rigid_fault(pose) is None
    assert rotation_error(np.stack([pose[:3, :3], 2 * pose[:3, :3]])) == pytest.approx([0, 3])
    for damaged, words in (
        (pose * [[2], [2], [2], [1]], "scaled by 2"),
        (pose * [-1, 1, 1, 1], "reflection"),
        (pose + np.eye(4)[3][:, None], "last row"),
        (pose * np.nan, "NaN"),
    ):
        assert words in rigid_fault(damaged)[0]


def test_camera_axes_are_swapped_and_swapped_back():
    pose = np.arange(16.0).reshape(4, 4)
    assert np.array_equal(swap_camera_axes(swap_camera_axes(pose)), pose)
    assert camera_to_json(np.eye(4)) == [[1, 0, 0, 0], [0, -1, 0, 0], [0, 0, -1, 0], [0, 0, 0, 1]]
