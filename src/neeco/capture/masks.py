"""Loss masks compared with what they hide: lit pixels and sparse points."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from torch import Tensor

from neeco.geometry.camera import Camera
from neeco.geometry.projection import project_world
from neeco.plausible import Fault, mask_fault

LIT = 0.12  # brightness in [0, 1] of a pixel's brightest channel: a round field of view's dark border has less
MIN_LIT = 0.02  # share of an image: with fewer lit pixels it is not counted


@dataclass(frozen=True)
class Hidden:
    """Content hidden by one loss mask."""

    pixels: float | None  # share of the lit pixels; None: too few are lit
    points: int  # projected sparse points
    points_in_view: int


def measure_hidden(image: Tensor, mask: Tensor, camera: Camera | None, points: np.ndarray) -> Hidden:
    """Count what a loss mask bool [H, W], False where ignored, hides of an image [H, W, 3] in [0, 1], and of points
    [P, 3] mm in its camera (None: not known)."""
    lit, ignored = (image.amax(-1) > LIT).numpy(), ~mask.numpy()
    pixels = float(ignored[lit].mean()) if lit.mean() > MIN_LIT else None
    if camera is None or not len(points):
        return Hidden(pixels, 0, 0)
    with np.errstate(all="ignore"):  # points on the camera's plane
        places, depths = project_world(points, camera)
    inside = (depths > camera.near) & (places >= 0).all(-1) & (places < [camera.width, camera.height]).all(-1)
    column, row = places[inside].astype(int).T
    return Hidden(pixels, int(ignored[row, column].sum()), int(inside.sum()))


def masks_fault(found: Sequence[Hidden]) -> Fault | None:
    """Return what is wrong with loss masks that hide what was found, and what to do."""
    shares = [one.pixels for one in found if one.pixels is not None]
    if not shares:
        return None
    in_view = sum(one.points_in_view for one in found)
    points = sum(one.points for one in found) / in_view if in_view else None
    return mask_fault(float(np.median(shares)), points)
