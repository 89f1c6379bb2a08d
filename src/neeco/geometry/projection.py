"""Projection of points to images and back, for torch tensors and numpy arrays."""

from __future__ import annotations

from typing import Any, TypeVar

import numpy as np
import torch
from torch import Tensor

from neeco.geometry.camera import Camera
from neeco.geometry.distortion import pixels_of_rays, rays_of_pixels

Array = TypeVar("Array", Tensor, np.ndarray)

FIELD_MARGIN = 0.3  # share of half the field of view by which the linearisation point may lie outside


def project(points: Array, fx: Any, fy: Any, cx: Any, cy: Any, nearest: float | None = None) -> tuple[Array, Array]:
    """Columns and rows [...] px of points [..., 3] mm in a camera's frame (OpenCV axes, pixel centres at +0.5).

    fx, fy, cx, cy: px, numbers or what broadcasts with [...]. Points less deep than `nearest` mm, those behind the
    camera among them, count as that deep; without it a point on the camera's plane becomes infinite and one
    behind is mirrored. The order of operations, x / z * fx + cx, keeps results the same to the last bit.
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
        return np.stack(project_local(local, camera, nearest), axis=-1), local[..., 2]
    view = camera.world_from_camera.to(points)
    local = (points - view[:3, 3]) @ view[:3, :3]
    return torch.stack(project_local(local, camera, nearest), dim=-1), local[..., 2]


def unproject_world(pixels: Tensor, depths: Tensor, camera: Camera) -> Tensor:
    """Points [..., 3] mm of the world at pixels [..., 2] and depths [...] mm: the inverse of `project_world`."""
    pose = camera.world_from_camera.to(depths)
    u, v = pixels.unbind(-1)
    if camera.is_pinhole:
        slopes = torch.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy], -1)
    else:
        array = pixels.detach().cpu().double().numpy()
        slopes = torch.from_numpy(rays_of_pixels(array.reshape(-1, 2), camera).reshape(array.shape)).to(pixels)
    rays = torch.cat([slopes, torch.ones_like(u)[..., None]], -1)
    return (rays * depths[..., None]) @ pose[:3, :3].T + pose[:3, 3]


def pixel_centers(rows: int, columns: int) -> Tensor:
    """Centres [rows, columns, 2] of an image's pixels, column before row."""
    down, across = torch.meshgrid(torch.arange(rows) + 0.5, torch.arange(columns) + 0.5, indexing="ij")
    return torch.stack([across, down], -1)


def in_image(points: Tensor, camera: Camera) -> Tensor:
    """Mask [P] bool of points [P, 3] mm of the world that project into the image, whether occluded or not."""
    pixels, depths = project_world(points, camera)
    u, v = pixels.unbind(-1)
    return (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height) & (depths > camera.near)


def project_local(points: Array, camera: Camera, nearest: float | None = None) -> tuple[Array, Array]:
    """Columns and rows [...] px of points [..., 3] mm in the camera's frame, through its lens; NaN outside its field of
    view. No gradients through a lens."""
    if camera.is_pinhole:
        return project(points, camera.fx, camera.fy, camera.cx, camera.cy, nearest)
    if isinstance(points, Tensor):
        u, v = project_local(points.detach().cpu().double().numpy(), camera, nearest)
        return torch.from_numpy(u).to(points), torch.from_numpy(v).to(points)
    slopes = np.stack(project(points, 1.0, 1.0, 0.0, 0.0, nearest), -1)
    pixels = pixels_of_rays(slopes.reshape(-1, 2), camera).reshape(slopes.shape)
    return pixels[..., 0], pixels[..., 1]


def field_slopes(camera: Camera, camera_means: Tensor) -> Tensor:
    """Slopes x/z and y/z [N, 2] of means [N, 3] (mm, camera frame), clamped to the field of view and its margin.

    A Gaussian at the side of the camera has enormous slopes and may still reach into the image.
    """
    margin_x = FIELD_MARGIN * 0.5 * camera.width / camera.fx
    margin_y = FIELD_MARGIN * 0.5 * camera.height / camera.fy
    x, y, z = camera_means.unbind(-1)
    across = (x / z).clamp(-camera.cx / camera.fx - margin_x, (camera.width - camera.cx) / camera.fx + margin_x)
    down = (y / z).clamp(-camera.cy / camera.fy - margin_y, (camera.height - camera.cy) / camera.fy + margin_y)
    return torch.stack([across, down], dim=-1)
