"""The rendered captures' truth agrees with itself: masks, depth, poses and the hinge they state."""

from __future__ import annotations

import json
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from PIL import Image
from rendered_truth import frames_with_depth, labels, seen_points, sensor_from_camera, truth_of

from neeco.capture import check_capture, errors_only, read_capture

FOCAL, WIDTH, HEIGHT = 36.25, 40, 32
SHAFT, JAW_LEFT, JAW_RIGHT = 1, 3, 4


@pytest.fixture(scope="module", params=["bowel", "stomach"])
def capture(request: pytest.FixtureRequest, benchmarks: ModuleType, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A scene's whole pipeline for six frames of 40x32: four to train on, one `test`, one `unseen`."""
    from rendered.frames import Settings
    from rendered.render import Lens
    from rendered.scenes import SCENES
    from rendered.writing import write_recording

    path = tmp_path_factory.mktemp(request.param)
    settings = Settings(Lens(WIDTH, HEIGHT, FOCAL), resolution=240, every=50)
    write_recording(SCENES[request.param], path, settings)
    return path


def hinge(capture: Path) -> dict:
    return json.loads((capture / "truth" / "hinge.json").read_text())


def test_capture_reads_and_has_no_errors(capture: Path) -> None:
    assert len(read_capture(capture).frames) == 6
    assert errors_only(check_capture(capture)) == []


def test_shaft_depth_lies_on_the_stated_cylinder(capture: Path) -> None:
    truth, checked = hinge(capture), 0
    for frame in frames_with_depth(capture):
        points, ids = seen_points(capture, frame)
        arm = points[ids == SHAFT] - truth["shaft_origin"]
        axis = np.array(truth["shaft_direction"])
        distance = np.linalg.norm(arm - (arm @ axis)[:, None] * axis, axis=-1)
        assert np.abs(distance - truth["shaft_radius_mm"]).max(initial=0) < 0.06
        checked += len(arm)
    assert checked > 10


def test_hinge_projects_onto_the_instrument_at_its_depth(capture: Path) -> None:
    truth, checked = hinge(capture), 0
    for frame in frames_with_depth(capture):
        camera_from_sensor = np.linalg.inv(sensor_from_camera(frame))
        x, y, z = camera_from_sensor[:3, :3] @ truth["hinge_pivot"] + camera_from_sensor[:3, 3]
        u, v = FOCAL * x / z + WIDTH / 2, FOCAL * y / z + HEIGHT / 2
        if 1 < u < WIDTH - 1 and 1 < v < HEIGHT - 1:
            assert labels(capture, frame)[int(v), int(u)] > SHAFT
            depth = np.array(Image.open(capture / "truth" / frame["depth_file_path"])) * 0.05
            near = depth[int(v) // 2 : int(v) // 2 + 2, int(u) // 2 : int(u) // 2 + 2]
            assert np.abs(near - z).min() < 2 * truth["shaft_radius_mm"]
            checked += 1
    assert checked >= 2


def test_jaws_open_to_the_sides_their_names_say(capture: Path) -> None:
    truth, checked = hinge(capture), 0
    axis = np.array(truth["hinge_axis"])
    assert axis[np.abs(axis).argmax()] > 0
    left_side = np.cross(truth["shaft_direction"], axis)
    for frame in frames_with_depth(capture):
        points, ids = seen_points(capture, frame)
        left, right = ((points[ids == part] - truth["hinge_pivot"]) @ left_side for part in (JAW_LEFT, JAW_RIGHT))
        if frame["state"]["opening"] > 0.3 and len(left) and len(right):
            assert left.mean() > right.mean() + 1
            checked += 1
    assert checked


def test_recorded_poses_err_but_little(capture: Path) -> None:
    recorded = json.loads((capture / "transforms.json").read_text())["frames"]
    for found, true in zip(recorded, truth_of(capture)["frames"], strict=True):
        shift = np.array(found["transform_matrix"])[:3, 3] - np.array(true["transform_matrix"])[:3, 3]
        assert 0.3 < np.linalg.norm(shift) < 4
        drift = np.array(found["instruments"][0]["pose"]) - np.array(true["instruments"][0]["pose"])
        assert 0.01 < np.linalg.norm(drift[:3, 3]) < 3
