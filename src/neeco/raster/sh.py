"""Colour of Gaussians in plain torch, any float type and device: spherical harmonics and the headlight."""

from __future__ import annotations

import torch
from torch import Tensor

from neeco.raster.pinhole import field_slopes
from neeco.raster.types import Camera, Headlight

SH_C0 = 0.28209479177387814  # the constant harmonic
HALF = 0.5 / SH_C0  # by how much of it colours are more than harmonics say


def rotation_matrices(quats: Tensor) -> Tensor:
    """Rotation matrices [N, 3, 3] of quaternions [N, 4] wxyz, taken as unit."""
    w, x, y, z = quats.unbind(-1)
    rows = [
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ]  # fmt: skip
    return torch.stack(rows, dim=-1).reshape(-1, 3, 3)


def sh_basis(directions: Tensor, count: int) -> Tensor:
    """Real spherical harmonics [N, count] at unit directions [N, 3], constants and signs of 3D Gaussian Splatting."""
    x, y, z = directions.unbind(-1)
    basis = [torch.full_like(x, SH_C0)]
    if count > 1:
        basis += [-0.4886025119029199 * y, 0.4886025119029199 * z, -0.4886025119029199 * x]
    xx, yy, zz = x * x, y * y, z * z
    if count > 4:
        basis += [
            1.0925484305920792 * x * y,
            -1.0925484305920792 * y * z,
            0.31539156525252005 * (2 * zz - xx - yy),
            -1.0925484305920792 * x * z,
            0.5462742152960396 * (xx - yy),
        ]
    if count > 9:
        basis += [
            -0.5900435899266435 * y * (3 * xx - yy),
            2.890611442640554 * x * y * z,
            -0.4570457994644658 * y * (4 * zz - xx - yy),
            0.3731763325901154 * z * (2 * zz - 3 * xx - 3 * yy),
            -0.4570457994644658 * x * (4 * zz - xx - yy),
            1.445305721320277 * z * (xx - yy),
            -0.5900435899266435 * x * (xx - 3 * yy),
        ]
    return torch.stack(basis, dim=-1)


def brightened(sh: Tensor, factor: Tensor) -> Tensor:
    """Harmonics [N, K, 3] with the colours, half a unit more than they say, multiplied by `factor` [N, 1, 1] or [3]."""
    lit = sh * factor
    lit[:, :1] += HALF * (factor - 1)
    return lit


def sh_colors(sh: Tensor, means: Tensor, camera_centre: Tensor, sh_frames: Tensor | None) -> Tensor:
    """Colours [N, 3] = sh . basis(direction) + 0.5, not clamped; sh [N, K, 3]; means [N, 3], centre [3]: world."""
    directions = torch.nn.functional.normalize(means - camera_centre, dim=-1)
    if sh_frames is not None:
        world_from_sh = rotation_matrices(sh_frames.detach())
        directions = torch.einsum("nij,ni->nj", world_from_sh, directions)
    return torch.einsum("nk,nkc->nc", sh_basis(directions, sh.shape[1]), sh) + 0.5


def headlight_factor(headlight: Headlight, camera: Camera, camera_means: Tensor) -> Tensor:
    """Brightness [N] of the headlight at means [N, 3] in the camera frame, mm, with what shadows leave of it."""
    x, y, z = camera_means.unbind(-1)
    log_distance = 0.5 * torch.log((x * x + y * y + z * z) / 100.0**2)
    t = field_slopes(camera, camera_means).square().sum(-1)
    factor = torch.exp(headlight.vignette[0] * t + headlight.vignette[1] * t * t - headlight.falloff * log_distance)
    return factor if headlight.left is None else factor * headlight.left
