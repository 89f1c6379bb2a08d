"""What moves with a tracked pose is the instrument, and its features are found again in the images."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from neeco.geometry.lens import Lens
from neeco.ingest.foreground.masks import FLOW, ResidualFlow
from neeco.ingest.foreground.rough_shape import best_lag, carve_shape, lag_of, observations_on, project_mask
from neeco.ingest.frames.images import SfmResult, Views

PINHOLE = Lens(60.0, 60.0, 32.0, 24.0, (), (64, 48))
ROWS = np.arange(14)


def poses() -> np.ndarray:
    """[R, 4, 4] camera_from_instrument of an instrument that crosses the image."""
    found = np.tile(np.eye(4), (len(ROWS), 1, 1))
    found[:, :3, 3] = np.stack([20 * np.sin(ROWS / 2), 10 * np.cos(ROWS / 1.5), 100 + ROWS], 1)
    return found


def moving_at(places: np.ndarray) -> np.ndarray:
    """[R, h, w] evidence of motion about one point [R, 3] mm of the camera's frame."""
    evidence = np.zeros((len(places), 48 // FLOW.step_px, 64 // FLOW.step_px))
    for pixels, (x, y, z) in zip(evidence, places, strict=True):
        column, row = int((60 * x / z + 32) / FLOW.step_px), int((60 * y / z + 24) / FLOW.step_px)
        pixels[max(row - 1, 0) : row + 2, max(column - 1, 0) : column + 2] = 1.0
    return evidence


def test_the_shape_lies_where_the_moving_pixels_are() -> None:
    shape = carve_shape(moving_at(poses()[:, :3, 3]), poses(), PINHOLE)
    assert shape is not None
    assert shape.agreement > 0.9
    assert np.linalg.norm(np.median(shape.points, axis=0)[:2]) < 2 * shape.spacing


@pytest.mark.parametrize("late", [0.0, 2.8])
def test_poses_logged_late_fit_what_moves_at_another_lag(late: float) -> None:
    def poses_at(times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        found = np.tile(np.eye(4), (len(times), 1, 1))
        found[:, :3, 3] = np.stack([20 * np.sin(2 * times), 14 * np.cos(1.3 * times**1.2), 100 + times], 1)
        return found, times < 30

    times = np.arange(2.0, 12.0, 0.5)
    evidence = moving_at(poses_at(times)[0][:, :3, 3])
    lag = best_lag(evidence, lambda lag: poses_at(np.maximum(times - late + lag, 0)), PINHOLE, 4.0)
    assert lag == pytest.approx(late, abs=0.1)


def test_agreement_with_a_flat_top_contradicts_no_clock() -> None:
    """The agreement of a robot's instrument whose clock was right, every 0.1 s from 0.5 s earlier to 0.5 s later."""
    measured = [0.365, 0.399, 0.415, 0.485, 0.596, 0.541, 0.573, 0.473, 0.388, 0.334, 0.312]
    assert lag_of(np.array(measured)) == 0.0
    assert lag_of(np.array([*[0.3] * 6, *measured])) == pytest.approx(0.3, abs=0.05)  # of the same, 0.3 s late


def test_motion_that_follows_no_pose_gives_no_shape() -> None:
    evidence = np.random.default_rng(0).uniform(0, 0.2, (len(ROWS), 48 // FLOW.step_px, 64 // FLOW.step_px))
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


@pytest.mark.parametrize("times", [1, 4])
def test_what_moves_is_told_alike_in_small_and_large_images(times: int) -> None:
    """A patch that moves by 4 px of 320x256 moves, and the tissue beside it, by .6 px, does not: in any size."""
    width, height = 320, 256
    wall = cv2.GaussianBlur(np.random.default_rng(0).uniform(0, 255, (height, width, 3)), (0, 0), 2.0)
    wall = np.clip((wall - 128) * 8 + 128, 0, 255)

    def load(row: int) -> np.ndarray:
        shifted = cv2.warpAffine(wall, np.array([[1, 0, 0.6 * (row > 0)], [0, 1, 0]]), (width, height), borderMode=1)
        column = 100 + 4 * (row > 0)
        shifted[100:164, column : column + 80] = wall[20:84, 20:100]
        return cv2.resize(shifted.astype(np.uint8), (times * width, times * height), interpolation=cv2.INTER_CUBIC)

    rows, columns = np.mgrid[8:height:16, 8:width:16]
    points = np.stack([(columns - width / 2) / 3, (rows - height / 2) / 3, np.full(rows.shape, 100.0)], -1).reshape(
        -1, 3
    )
    seen = [[frame, point, 0, 0, point] for frame in range(4) for point in range(len(points))]
    count = np.zeros(len(points))
    sfm = SfmResult(
        indices=np.arange(4), world_from_camera=np.tile(np.eye(4), (4, 1, 1)), points=points, colors=count[:, None],
        errors=count, lengths=count, observations=np.array(seen), lens=None, reprojection_px=0.0,
    )  # fmt: skip
    visible = np.ones((times * height, times * width), bool)
    visible[:, : 40 * times] = False
    lens = Lens(
        300.0 * times, 300.0 * times, width * times / 2, height * times / 2, (), (times * width, times * height)
    )
    views = Views(
        rows=np.arange(4), frames=np.arange(4), times=np.arange(4) / 25, episodes=np.zeros(4),
        world_from_camera=sfm.world_from_camera, load=load, pinhole=lens, visible=visible,
    )  # fmt: skip
    evidence = ResidualFlow(sfm, views).moving_pixels(np.array([0]), 1.5)[0]
    assert evidence.shape == (height // FLOW.step_px, width // FLOW.step_px)
    assert np.isnan(evidence[:, : 40 // FLOW.step_px]).all()
    assert not np.isnan(evidence[:, 60 // FLOW.step_px :]).any()
    inside = np.zeros(evidence.shape, bool)
    inside[110 // FLOW.step_px : 150 // FLOW.step_px, 115 // FLOW.step_px : 165 // FLOW.step_px] = True
    assert evidence[inside].mean() > 0.8
    assert np.nanmean(evidence[:20]) < 0.05
