"""Axis conventions: a point in front, left and up of a camera lands there, whoever wrote its numbers."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from neeco.geometry.conventions import CONVENTIONS, OPENGL, swap_camera_axes

DOCS = Path(__file__).parents[2] / "docs" / "capture.md"
SEEN = [-20.0, -10.0, 100.0]  # 20 mm to the left, 10 up, 100 in front, in OpenCV's axes
WRITTEN = {
    "opencv": [-20, -10, 100],
    "colmap": [-20, -10, 100],
    "ros_optical": [-20, -10, 100],
    "ros_body": [100, 20, 10],
    "ecm": [20, 10, 100],
    "opengl": [-20, 10, -100],
    "llff": [-10, -20, -100],
}  # the same point as each producer writes it


def pose(place: list[float], turn: list[float]) -> np.ndarray:
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_rotvec(turn).as_matrix()
    matrix[:3, 3] = place
    return matrix


@pytest.mark.parametrize("name", CONVENTIONS)
def test_a_point_lands_where_it_is_seen(name):
    convention = CONVENTIONS[name]
    body = pose(WRITTEN[name], [0.3, -0.2, 0.5])
    np.testing.assert_array_equal(convention.poses_to_opencv(body)[:3, 3], SEEN)
    assert np.linalg.det(convention.opencv_from_own) == 1  # a rotation: nothing is mirrored
    # the same camera somewhere in a world, whose pose is written in its own axes
    camera = pose([5, 6, 7], [0.1, 0.7, -0.4])
    point = camera @ [*WRITTEN[name], 1]
    turned = convention.camera_to_opencv(camera)
    np.testing.assert_allclose(np.linalg.inv(turned) @ point, [*SEEN, 1], atol=1e-12)


def test_transforms_files_have_opengl_axes():
    camera = pose([5, 6, 7], [0.1, 0.7, -0.4])
    np.testing.assert_array_equal(swap_camera_axes(camera), OPENGL.camera_to_opencv(camera))


def test_the_docs_show_the_same_table():
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in DOCS.read_text().splitlines()]
    shown = {row[0]: row[1:4] for row in rows if len(row) >= 4}
    for convention in CONVENTIONS.values():
        assert shown[convention.producer] == [convention.x, convention.y, convention.z]
