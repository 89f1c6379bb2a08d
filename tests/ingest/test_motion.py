"""What moves with a tracked pose is the instrument, and its features are found again in the images."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("cv2")

from neeco.capture.lens import Lens
from neeco.ingest.motion import STEP, carve_shape, observations_on, project_mask

PINHOLE = Lens(60.0, 60.0, 32.0, 24.0, (), (64, 48))
ROWS = np.arange(14)


def poses() -> np.ndarray:
    """[R, 4, 4] camera_from_instrument of an instrument that crosses the image."""
    found = np.tile(np.eye(4), (len(ROWS), 1, 1))
    found[:, :3, 3] = np.stack([20 * np.sin(ROWS / 2), 10 * np.cos(ROWS / 1.5), 100 + ROWS], 1)
    return found


def moving_at(places: np.ndarray) -> np.ndarray:
    """[R, h, w] evidence of motion about one point [R, 3] mm of the camera's frame."""
    evidence = np.zeros((len(places), 48 // STEP, 64 // STEP))
    for pixels, (x, y, z) in zip(evidence, places, strict=True):
        column, row = int((60 * x / z + 32) / STEP), int((60 * y / z + 24) / STEP)
        pixels[max(row - 1, 0) : row + 2, max(column - 1, 0) : column + 2] = 1.0
    return evidence


def test_the_shape_lies_where_the_moving_pixels_are() -> None:
    shape = carve_shape(moving_at(poses()[:, :3, 3]), poses(), PINHOLE)
    assert shape is not None
    assert shape.agreement > 0.9
    assert np.linalg.norm(np.median(shape.points, axis=0)[:2]) < 2 * shape.spacing


def test_motion_that_follows_no_pose_gives_no_shape() -> None:
    evidence = np.random.default_rng(0).uniform(0, 0.2, (len(ROWS), 48 // STEP, 64 // STEP))
    assert carve_shape(evidence, poses(), PINHOLE) is None


def test_only_features_on_the_instrument_are_marked(recorded) -> None:
    shape = carve_shape(moving_at(poses()[:, :3, 3]), poses(), PINHOLE)
    assert shape is not None
    sfm = recorded.reconstruct([f"{row:06d}.png" for row in ROWS], PINHOLE.intrinsics)
    camera = PINHOLE.camera(recorded.cameras(ROWS / 25.0)[3])
    mask = project_mask(shape, poses()[3], camera)
    on = observations_on(shape, poses()[3], sfm, 3, recorded.points, camera)
    mine = sfm.observations[:, 0] == 3
    assert not on[~mine].any()
    inside = mask[sfm.observations[mine, 3].astype(int), sfm.observations[mine, 2].astype(int)]
    np.testing.assert_array_equal(on[mine], inside)
    assert 0 < inside.sum() < mine.sum()
