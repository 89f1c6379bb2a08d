"""Measure what loss masks hide of the images and of the sparse points, which tells masks of inverted polarity."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from torch import Tensor

from neeco.capture.points import PointCloud
from neeco.geometry.camera import Camera
from neeco.geometry.projection import project_world
from neeco.plausible import Fault, mask_fault

LIT = 0.12  # brightness in [0, 1] of a pixel's brightest channel: a round field of view's dark border has less
MIN_LIT = 0.02  # share of an image: with fewer lit pixels it tells nothing
SAMPLED_POINTS = 500  # of the sparse points


@dataclass(frozen=True)
class Hidden:
    """What one mask hides."""

    pixels: float | None  # share of the lit pixels; None: too few are lit
    points: int  # projected sparse points
    points_in_view: int


def measure_hidden(image: Tensor, mask: Tensor, camera: Camera | None, points: np.ndarray) -> Hidden:
    """What a loss mask bool [H, W], False where ignored, hides of an image [H, W, 3] in [0, 1], and of points [P, 3] mm
    as `camera` sees them (None: not known)."""
    lit, ignored = (image.amax(-1) > LIT).numpy(), ~mask.numpy()
    pixels = float(ignored[lit].mean()) if lit.mean() > MIN_LIT else None
    if camera is None or not len(points):
        return Hidden(pixels, 0, 0)
    with np.errstate(all="ignore"):  # points on the camera's plane
        places, depths = project_world(points, camera)
    inside = (depths > camera.near) & (places >= 0).all(-1) & (places < [camera.width, camera.height]).all(-1)
    column, row = places[inside].astype(int).T
    return Hidden(pixels, int(ignored[row, column].sum()), int(inside.sum()))


def sample_points(cloud: PointCloud | None) -> np.ndarray:
    """[P, 3] float64 mm, some of the measured points; none where there are none."""
    if cloud is None or not cloud.measured:
        return np.zeros((0, 3))
    return cloud.positions[:: max(1, len(cloud.positions) // SAMPLED_POINTS)].astype(np.float64)


def masks_fault(found: Sequence[Hidden]) -> Fault | None:
    """What is wrong with loss masks, of which each hides as found, and what to do."""
    shares = [one.pixels for one in found if one.pixels is not None]
    if not shares:
        return None
    in_view = sum(one.points_in_view for one in found)
    points = sum(one.points for one in found) / in_view if in_view else None
    return mask_fault(float(np.median(shares)), points)
