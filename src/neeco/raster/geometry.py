"""Where points fall in a pinhole camera's image, and rotations and rigid transforms. Quaternions are wxyz."""

from __future__ import annotations

from typing import Any, TypeVar

import numpy as np
import torch
from torch import Tensor

from neeco.raster.types import Camera

Array = TypeVar("Array", Tensor, np.ndarray)

FIELD_MARGIN = 0.3  # share of half the field of view by which the linearisation point may lie outside


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


def unproject_world(pixels: Tensor, depths: Tensor, camera: Camera) -> Tensor:
    """Points [..., 3] mm of the world seen at pixels [..., 2] in depths [...] mm: what `project_world` takes back."""
    pose = camera.world_from_camera.to(depths)
    u, v = pixels.unbind(-1)
    rays = torch.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, torch.ones_like(u)], -1)
    return (rays * depths[..., None]) @ pose[:3, :3].T + pose[:3, 3]


def pixel_centers(rows: int, columns: int) -> Tensor:
    """[rows, columns, 2] middles of an image's pixels, column before row."""
    down, across = torch.meshgrid(torch.arange(rows) + 0.5, torch.arange(columns) + 0.5, indexing="ij")
    return torch.stack([across, down], -1)


def in_image(points: Tensor, camera: Camera) -> Tensor:
    """[P] bool: which points [P, 3] mm of the world fall into the camera's image, whatever stands before them."""
    pixels, depths = project_world(points, camera)
    u, v = pixels.unbind(-1)
    return (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height) & (depths > camera.near)


def _intrinsic(points: Array, camera: Camera, nearest: float | None) -> tuple[Array, Array]:
    return project(points, camera.fx, camera.fy, camera.cx, camera.cy, nearest)


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


def quat_multiply(a: Tensor, b: Tensor) -> Tensor:
    """Hamilton product of quaternions [..., 4]: rotate by `b`, then by `a`."""
    aw, ax, ay, az = a.unbind(-1)
    bw, bx, by, bz = b.unbind(-1)
    return torch.stack(
        [
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ],
        -1,
    )


def quat_to_matrix(quats: Tensor) -> Tensor:
    """Unit quaternions [..., 4] to rotation matrices [..., 3, 3]."""
    w, x, y, z = quats.unbind(-1)
    entries = [
        1 - 2 * (y * y + z * z),
        2 * (x * y - w * z),
        2 * (x * z + w * y),
        2 * (x * y + w * z),
        1 - 2 * (x * x + z * z),
        2 * (y * z - w * x),
        2 * (x * z - w * y),
        2 * (y * z + w * x),
        1 - 2 * (x * x + y * y),
    ]
    return torch.stack(entries, -1).reshape(*quats.shape[:-1], 3, 3)


def matrix_to_quat(rotation: Tensor) -> Tensor:
    """Rotation matrices [..., 3, 3] to unit quaternions [..., 4] with w >= 0; differentiable.

    Picks, per matrix, the best conditioned of the four classic formulas (Shepperd 1978).
    """
    m = rotation.flatten(-2)
    m00, m01, m02, m10, m11, m12, m20, m21, m22 = m.unbind(-1)
    candidates = torch.stack(
        [
            torch.stack([1 + m00 + m11 + m22, m21 - m12, m02 - m20, m10 - m01], -1),
            torch.stack([m21 - m12, 1 + m00 - m11 - m22, m01 + m10, m02 + m20], -1),
            torch.stack([m02 - m20, m01 + m10, 1 - m00 + m11 - m22, m12 + m21], -1),
            torch.stack([m10 - m01, m02 + m20, m12 + m21, 1 - m00 - m11 + m22], -1),
        ],
        -2,
    )  # [..., 4, 4]
    best = candidates.detach().diagonal(dim1=-2, dim2=-1).argmax(-1)
    index = best[..., None, None].expand(*best.shape, 1, 4)
    quat = torch.nn.functional.normalize(candidates.gather(-2, index).squeeze(-2), dim=-1)
    return torch.where(quat[..., :1] < 0, -quat, quat)


def skew(vector: Tensor) -> Tensor:
    """[..., 3] to the matrix [..., 3, 3] with skew(v) @ x = v x x."""
    x, y, z = vector.unbind(-1)
    zero = torch.zeros_like(x)
    return torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).reshape(*vector.shape[:-1], 3, 3)


def rotation_from_vector(vector: Tensor) -> Tensor:
    """Rotation vectors [..., 3] (axis * angle, rad) to matrices [..., 3, 3]; differentiable at zero."""
    return torch.linalg.matrix_exp(skew(vector))


def vector_from_rotation(rotation: Tensor) -> Tensor:
    """Rotation matrices [..., 3, 3] to rotation vectors [..., 3], angle in [0, pi]."""
    quat = matrix_to_quat(rotation)
    axis = quat[..., 1:]
    sine = axis.norm(dim=-1, keepdim=True)
    angle = 2 * torch.atan2(sine, quat[..., :1])
    return axis * torch.where(sine > 1e-8, angle / sine.clamp_min(1e-12), torch.full_like(sine, 2.0))


def rigid(rotation: Tensor, translation: Tensor) -> Tensor:
    """Assemble [..., 4, 4] from rotations [..., 3, 3] and translations [..., 3]."""
    top = torch.cat([rotation, translation[..., None]], -1)
    bottom = torch.zeros_like(top[..., :1, :])
    bottom[..., 3] = 1
    return torch.cat([top, bottom], -2)


def rigid_from_vector(vector: Tensor) -> Tensor:
    """[..., 6] (rotation vector in rad, translation in mm) to [..., 4, 4]."""
    return rigid(rotation_from_vector(vector[..., :3]), vector[..., 3:])


def rotate_about(points: Tensor, axis: Tensor, pivot: Tensor, angle: Tensor) -> Tensor:
    """Turn points [M, 3] by `angle` [M] rad about the line through `pivot` [3] along the unit `axis` [3]
    (Rodrigues)."""
    arm = points - pivot
    cosine, sine = angle.cos()[:, None], angle.sin()[:, None]
    along = (arm @ axis)[:, None] * axis
    across = torch.linalg.cross(axis.expand_as(arm), arm)
    return pivot + arm * cosine + across * sine + along * (1 - cosine)


def axis_angle_quat(axis: Tensor, angle: Tensor) -> Tensor:
    """Unit `axis` [3] and `angle` [M] rad to quaternions [M, 4]."""
    half = angle[:, None] / 2
    return torch.cat([half.cos(), half.sin() * axis], -1)
