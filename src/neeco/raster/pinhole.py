"""Where points fall in the image of a pinhole camera, for torch tensors and numpy arrays alike."""

from __future__ import annotations

from typing import Any, TypeVar

import numpy as np
import torch
from torch import Tensor

from neeco.raster.types import Camera

Array = TypeVar("Array", Tensor, np.ndarray)


def project(points: Array, fx: Any, fy: Any, cx: Any, cy: Any, nearest: float | None = None) -> tuple[Array, Array]:
    """Columns and rows [...] px of points [..., 3] mm in a camera's frame (OpenCV axes, pixel centres at +0.5).

    fx, fy, cx, cy: px, numbers or what broadcasts with [...]. Points less deep than `nearest` mm, those behind the
    camera among them, are taken to be that deep; without it a point on the camera's plane becomes infinite and one
    behind is mirrored. In this order of operations, for results that stay the same to the last bit: x / z * fx + cx.
    """
    x, y, z = points[..., 0], points[..., 1], points[..., 2]
    if nearest is not None:
        z = z.clip(nearest)
    return x / z * fx + cx, y / z * fy + cy


def project_world(points: Array, camera: Camera, nearest: float | None = None) -> tuple[Array, Array]:
    """Pixel positions [..., 2] and depths [...] mm of points [..., 3] mm of the world; `nearest` as in `project`.

    Tensors give tensors of their own type and device, arrays float64. A depth of 0 or less lies behind the camera.
    """
    if isinstance(points, np.ndarray):
        pose = camera.world_from_camera.detach().cpu().double().numpy()
        local = (points - pose[:3, 3]) @ pose[:3, :3]
        return np.stack(_intrinsic(local, camera, nearest), axis=-1), local[..., 2]
    view = camera.world_from_camera.to(points)
    seen = (points - view[:3, 3]) @ view[:3, :3]
    return torch.stack(_intrinsic(seen, camera, nearest), dim=-1), seen[..., 2]


def _intrinsic(points: Array, camera: Camera, nearest: float | None) -> tuple[Array, Array]:
    return project(points, camera.fx, camera.fy, camera.cx, camera.cy, nearest)
