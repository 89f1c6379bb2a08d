"""Where the projection is linearised: at a Gaussian's mean, or at the field of view's edge where it lies beyond."""

from __future__ import annotations

import torch
from torch import Tensor

from neeco.raster.types import Camera

FIELD_MARGIN = 0.3  # share of half the field of view by which the linearisation point may lie outside


def field_slopes(camera: Camera, camera_means: Tensor) -> Tensor:
    """x/z and y/z [N, 2] of means [N, 3] (mm, camera frame), brought into the field of view and its margin.

    A Gaussian beside the camera, whose slopes are enormous, may still reach into the image.
    """
    margin_x = FIELD_MARGIN * 0.5 * camera.width / camera.fx
    margin_y = FIELD_MARGIN * 0.5 * camera.height / camera.fy
    x, y, z = camera_means.unbind(-1)
    across = (x / z).clamp(-camera.cx / camera.fx - margin_x, (camera.width - camera.cx) / camera.fx + margin_x)
    down = (y / z).clamp(-camera.cy / camera.fy - margin_y, (camera.height - camera.cy) / camera.fy + margin_y)
    return torch.stack([across, down], dim=-1)
