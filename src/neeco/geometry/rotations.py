"""Rotations and rigid transforms, differentiable. Quaternions are wxyz."""

from __future__ import annotations

from typing import Any, TypeVar

import numpy as np
import torch
from torch import Tensor

from neeco.base.errors import NeecoError

Array = TypeVar("Array", Tensor, np.ndarray)

RIGID_TOLERANCE = 2e-3  # of R^T R - I; JSON with three decimals passes, a scale of 1.001 passes, a shear does not
MAX_ENTRY = 1e9  # of a pose


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


def rigid(rotation: Array, translation: Array) -> Array:
    """Assemble poses [..., 4, 4] from rotations [..., 3, 3] and translations [..., 3], tensors or float64 arrays."""
    if isinstance(rotation, np.ndarray):
        pose = np.zeros((*rotation.shape[:-2], 4, 4))
        pose[..., :3, :3], pose[..., :3, 3], pose[..., 3, 3] = rotation, translation, 1
        return pose
    top = torch.cat([rotation, translation[..., None]], -1)
    bottom = torch.zeros_like(top[..., :1, :])
    bottom[..., 3] = 1
    return torch.cat([top, bottom], -2)


def rigid_from_vector(vector: Tensor) -> Tensor:
    """[..., 6] (rotation vector in rad, translation in mm) to [..., 4, 4]."""
    return rigid(rotation_from_vector(vector[..., :3]), vector[..., 3:])


def rotate_about(points: Tensor, axis: Tensor, pivot: Tensor, angle: Tensor) -> Tensor:
    """Rotate points [M, 3] by `angle` [M] rad about the line through `pivot` [3] along unit `axis` [3] (Rodrigues)."""
    arm = points - pivot
    cosine, sine = angle.cos()[:, None], angle.sin()[:, None]
    along = (arm @ axis)[:, None] * axis
    across = torch.linalg.cross(axis.expand_as(arm), arm)
    return pivot + arm * cosine + across * sine + along * (1 - cosine)


def axis_angle_quat(axis: Tensor, angle: Tensor) -> Tensor:
    """Unit `axis` [3] and `angle` [M] rad to quaternions [M, 4]."""
    half = angle[:, None] / 2
    return torch.cat([half.cos(), half.sin() * axis], -1)


def spread_directions(count: int) -> Tensor:
    """Unit directions [count, 3] float64, evenly spread (a spiral by the golden angle)."""
    k = torch.arange(count, dtype=torch.float64)
    z, turn = 1 - (2 * k + 1) / count, k * torch.pi * (3 - 5**0.5)
    ring = (1 - z * z).sqrt()
    return torch.stack([ring * turn.cos(), ring * turn.sin(), z], 1)


def rotation_error(matrices: np.ndarray) -> np.ndarray:
    """Deviation [...] of matrices [..., 3, 3] from orthonormal: the largest entry of R^T R - I."""
    return np.abs(np.swapaxes(matrices, -1, -2) @ matrices - np.eye(3)).max(axis=(-2, -1))


def rigid_fault(matrix: np.ndarray) -> tuple[str, str] | None:
    """Return why a matrix [4, 4] float64 is no rigid transform, and what to do; None when it is one."""
    if not np.isfinite(matrix).all():
        return "contains NaN or infinity", "drop the frame or repair its pose"
    if np.abs(matrix).max() > MAX_ENTRY:
        return f"has entries beyond {MAX_ENTRY:g}", "repair the pose; lengths are millimetres"
    if np.abs(matrix[3] - [0, 0, 0, 1]).max() > 1e-6:
        transposed = np.abs(matrix[:, 3] - [0, 0, 0, 1]).max() <= 1e-6
        remedy = "transpose it: the translation is the last column" if transposed else "repair the matrix"
        return "is not rigid: the last row is not 0 0 0 1", remedy
    rotation = matrix[:3, :3]
    if rotation_error(rotation) > RIGID_TOLERANCE:
        scale = float(np.cbrt(abs(np.linalg.det(rotation))))
        if scale > 0 and rotation_error(rotation / scale) <= RIGID_TOLERANCE:
            return f"is not rigid: its rotation is scaled by {scale:.4g}", "divide the 3x3 corner by that"
        return "is not rigid: its 3x3 corner is not a rotation", "repair the matrix (unit quaternion?)"
    if np.linalg.det(rotation) < 0:
        return "is a reflection, not a rotation (determinant -1)", "repair the handedness of the axes"
    return None


def as_pose(value: Any, field: str, dtype: torch.dtype) -> Tensor:
    """Return a rigid transform [4, 4], a tensor, an array or nested lists, as a tensor.

    A tensor of floats is returned with its type, device and gradients; only its shape is checked. Anything else is
    copied to `dtype` on the CPU. Raises NeecoError naming `field` for another shape, and for arrays and lists that are
    not a rotation and translation.
    """
    if isinstance(value, Tensor) and value.is_floating_point():
        if value.shape != (4, 4):
            raise NeecoError(f"{field}: expected a 4x4 matrix, found shape {tuple(value.shape)}")
        return value
    try:
        matrix = np.array(value, dtype=np.float64)
    except (TypeError, ValueError):
        raise NeecoError(f"{field}: expected a 4x4 matrix of numbers, found {type(value).__name__}") from None
    if matrix.shape != (4, 4):
        raise NeecoError(f"{field}: expected a 4x4 matrix, found shape {matrix.shape}")
    if (fault := rigid_fault(matrix)) is not None:
        raise NeecoError(f"{field}: {fault[0]}; {fault[1]}")
    return torch.from_numpy(matrix).to(dtype)


def position_text(pose: Tensor) -> str:
    """The position of a pose [4, 4] in mm, for a one-line description."""
    return f"({', '.join(number_text(value) for value in pose[:3, 3])}) mm"


def number_text(value: float | Tensor) -> str:
    """A number to four digits; "?" for a tensor without values."""
    return "?" if isinstance(value, Tensor) and value.is_meta else f"{float(value):.4g}"
