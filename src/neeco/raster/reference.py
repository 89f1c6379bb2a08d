"""The definition of rendering: plain torch, dense, differentiable by autograd, in the float type of the inputs.

Every Gaussian is evaluated at every pixel: use it to understand and to test, not to train.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from neeco.geometry.camera import Camera
from neeco.geometry.projection import field_slopes
from neeco.geometry.rotations import quat_to_matrix
from neeco.raster.types import Gaussians, Headlight, Rendering

LOW_PASS = 0.3  # px^2 added to projected covariances
MIN_ALPHA = 1 / 255  # smaller alphas are not rendered
MAX_ALPHA = 0.999
MIN_TRANSMITTANCE = 1e-4  # transmittance below which a pixel is saturated


@dataclass(frozen=True)
class Projection:
    """Gaussians in the image."""

    centers: Tensor  # [N, 2] px
    covariances: Tensor  # [N, 2, 2] px^2, with the low-pass
    depths: Tensor  # [N] mm


def rasterize_reference(
    gaussians: Gaussians, camera: Camera, channels: Tensor | None, background: Tensor | None
) -> Rendering:
    """`rasterize` as its definition, on the device of the means. Memory is proportional to Gaussians x pixels."""
    means = gaussians.means
    offsets = torch.zeros(len(gaussians), 2, dtype=means.dtype, device=means.device)
    offsets.requires_grad_(torch.is_grad_enabled())
    camera = camera.to(means.device)
    rotation, translation = camera_from_world(camera.world_from_camera.to(means.dtype))
    usable = usable_gaussians(gaussians, camera, channels)
    gaussians, channels = _hide(gaussians, channels, ~usable, camera)
    camera_means = gaussians.means @ rotation.T + translation
    centre = camera.world_from_camera[:3, 3].to(gaussians.means)
    colors = sh_colors(gaussians.sh, gaussians.means, centre, gaussians.sh_frames).clamp(min=0)
    if gaussians.headlight is not None:
        colors = colors * headlight_factor(gaussians.headlight, camera, camera_means)[:, None]
    values = torch.cat([colors, camera_means[:, 2:]], dim=-1)
    if channels is not None:
        values = torch.cat([values, channels], dim=-1)

    projection = project(gaussians, camera, camera_means, rotation, offsets)
    order = torch.argsort(depth_keys(gaussians.means, camera), stable=True)
    weights = blend_weights(projection, gaussians.opacities, order, camera)  # [P, N], near to far
    images = (weights @ values[order]).reshape(camera.height, camera.width, -1)
    alpha = weights.sum(dim=1).reshape(camera.height, camera.width)
    color = images[..., :3]
    if background is not None:
        color = color + (1 - alpha)[..., None] * background
    covered = alpha > 0
    depth = torch.where(covered, images[..., 3] / torch.where(covered, alpha, torch.ones_like(alpha)), 0.0)
    with torch.no_grad():  # 3 standard deviations along the longer axis, px; 0 for Gaussians below 1/255 at every pixel
        largest = torch.linalg.eigvalsh(projection.covariances)[:, -1]
        touching = (alphas_at_pixels(projection, gaussians.opacities, camera) >= MIN_ALPHA).any(dim=0)
        radii = torch.where(touching, 3 * largest.sqrt(), 0.0)
    return Rendering(color, alpha, depth, None if channels is None else images[..., 4:], radii, offsets)


def camera_from_world(world_from_camera: Tensor) -> tuple[Tensor, Tensor]:
    """Return rotation [3, 3] and translation [3] from world to camera: R^T and -R^T t."""
    rotation = world_from_camera[:3, :3].T
    return rotation, -(rotation @ world_from_camera[:3, 3])


def depth_keys(means: Tensor, camera: Camera) -> Tensor:
    """Return the depths [N] to sort by: computed in float64, summed in a fixed order, rounded once to float32."""
    with torch.no_grad():
        pose = camera.world_from_camera.double()
        axis, centre = pose[:3, 2], pose[:3, 3]
        offset = -(axis[0] * centre[0]) - axis[1] * centre[1] - axis[2] * centre[2]
        m = means.double()
        return (((axis[0] * m[:, 0] + axis[1] * m[:, 1]) + axis[2] * m[:, 2]) + offset).float()


def project(
    gaussians: Gaussians, camera: Camera, camera_means: Tensor, rotation: Tensor, offsets: Tensor
) -> Projection:
    """Project Gaussians to the image (EWA splatting, Zwicker et al. 2001).

    camera_means [N, 3] mm, rotation [3, 3] camera_from_world, offsets [N, 2] px added to the centres.
    """
    x, y, z = camera_means.unbind(-1)
    slope_x, slope_y = x / z, y / z
    centers = torch.stack([camera.fx * slope_x + camera.cx, camera.fy * slope_y + camera.cy], dim=-1) + offsets
    slope_x, slope_y = field_slopes(camera, camera_means).unbind(-1)
    zero = torch.zeros_like(z)
    jacobian = torch.stack(
        [camera.fx / z, zero, -camera.fx * slope_x / z, zero, camera.fy / z, -camera.fy * slope_y / z], dim=-1
    ).reshape(-1, 2, 3)
    quats = torch.nn.functional.normalize(gaussians.quats, dim=-1)
    u = jacobian @ rotation @ (quat_to_matrix(quats) * gaussians.scales[:, None, :])  # [N, 2, 3]
    covariances = u @ u.transpose(1, 2) + LOW_PASS * torch.eye(2, dtype=u.dtype, device=u.device)
    return Projection(centers, covariances, z)


def alphas_at_pixels(projection: Projection, opacities: Tensor, camera: Camera) -> Tensor:
    """Return alpha [P, N] of every Gaussian at every pixel centre, before any cut-off."""
    rows = torch.arange(camera.height, dtype=opacities.dtype, device=opacities.device) + 0.5
    columns = torch.arange(camera.width, dtype=opacities.dtype, device=opacities.device) + 0.5
    y, x = torch.meshgrid(rows, columns, indexing="ij")
    dx = x.reshape(-1, 1) - projection.centers[:, 0]
    dy = y.reshape(-1, 1) - projection.centers[:, 1]
    xx, xy, yy = projection.covariances[:, 0, 0], projection.covariances[:, 0, 1], projection.covariances[:, 1, 1]
    squared = (yy * dx * dx - 2 * xy * dx * dy + xx * dy * dy) / (xx * yy - xy * xy)
    return opacities * torch.exp(-0.5 * squared)


def blend_weights(projection: Projection, opacities: Tensor, order: Tensor, camera: Camera) -> Tensor:
    """Return the share [P, N] of each pixel that each Gaussian contributes, columns in `order`, near to far."""
    alphas = alphas_at_pixels(projection, opacities, camera)[:, order]
    alphas = torch.where(alphas >= MIN_ALPHA, alphas.clamp(max=MAX_ALPHA), 0.0)
    with torch.no_grad():
        taken = torch.cumprod(1 - alphas, dim=1) > MIN_TRANSMITTANCE
    alphas = torch.where(taken, alphas, 0.0)
    behind = torch.cumprod(1 - alphas, dim=1)
    before = torch.cat([torch.ones_like(behind[:, :1]), behind[:, :-1]], dim=1)
    return alphas * before


def usable_gaussians(gaussians: Gaussians, camera: Camera, channels: Tensor | None) -> Tensor:
    """Return the Gaussians in front of the camera with finite parameters and non-zero quaternions, [N] bool."""
    n = len(gaussians)
    light = gaussians.headlight
    tensors: list[Tensor | None] = [gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities]
    tensors += [gaussians.sh, gaussians.sh_frames, channels]
    tensors += [] if light is None else [light.falloff, light.left]
    good = depth_keys(gaussians.means, camera) > camera.near
    for tensor in tensors:
        if tensor is not None and n > 0:
            good &= torch.isfinite(tensor.detach()).reshape(n, -1).all(dim=1)
    return good & (gaussians.quats.detach().norm(dim=-1) > 0)


def _hide(
    gaussians: Gaussians, channels: Tensor | None, hidden: Tensor, camera: Camera
) -> tuple[Gaussians, Tensor | None]:
    """Return Gaussians and channels with the `hidden` [N] made transparent, finite, 1 mm before the camera, without
    gradients. Selecting the others instead would make shapes depend on values, which "meta" tensors do not have."""
    pose = camera.world_from_camera.detach().to(gaussians.means.dtype)

    def but(tensor: Tensor, value: Tensor | float) -> Tensor:
        return torch.where(hidden.reshape(-1, *[1] * (tensor.dim() - 1)), value, tensor)

    light = gaussians.headlight
    if light is not None:
        left = None if light.left is None else but(light.left, 1.0)
        light = Headlight(but(light.falloff, 0.0), light.vignette, left=left)
    visible = Gaussians(
        means=but(gaussians.means, pose[:3, 3] + pose[:3, 2]),
        quats=but(gaussians.quats, 1.0),
        scales=but(gaussians.scales, 1.0),
        opacities=but(gaussians.opacities, 0.0),
        sh=but(gaussians.sh, 0.0),
        sh_frames=None if gaussians.sh_frames is None else but(gaussians.sh_frames, 1.0),
        headlight=light,
    )
    return visible, None if channels is None else but(channels, 0.0)


SH_C0 = 0.28209479177387814  # the constant harmonic
COLOR_OFFSET = 0.5 / SH_C0  # colour 0.5, which is added to the harmonics, as a constant harmonic


def sh_basis(directions: Tensor, count: int) -> Tensor:
    """Return real spherical harmonics [N, count] at unit directions [N, 3], constants and signs of 3D Gaussian
    Splatting."""
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
    """Return harmonics [N, K, 3] whose colours, sh . basis + 0.5, are multiplied by `factor` [N, 1, 1] or [3]."""
    lit = sh * factor
    lit[:, :1] += COLOR_OFFSET * (factor - 1)
    return lit


def sh_colors(sh: Tensor, means: Tensor, camera_centre: Tensor, sh_frames: Tensor | None) -> Tensor:
    """Return colours [N, 3] = sh . basis(direction) + 0.5, not clamped; sh [N, K, 3]; means [N, 3], centre [3]:
    world."""
    directions = torch.nn.functional.normalize(means - camera_centre, dim=-1)
    if sh_frames is not None:
        world_from_sh = quat_to_matrix(sh_frames.detach())
        directions = torch.einsum("nij,ni->nj", world_from_sh, directions)
    return torch.einsum("nk,nkc->nc", sh_basis(directions, sh.shape[1]), sh) + 0.5


def headlight_factor(headlight: Headlight, camera: Camera, camera_means: Tensor) -> Tensor:
    """Return the brightness [N] of the headlight, with its shadows, at means [N, 3] mm in the camera frame."""
    x, y, z = camera_means.unbind(-1)
    log_distance = 0.5 * torch.log((x * x + y * y + z * z) / 100.0**2)
    t = field_slopes(camera, camera_means).square().sum(-1)
    factor = torch.exp(headlight.vignette[0] * t + headlight.vignette[1] * t * t - headlight.falloff * log_distance)
    return factor if headlight.left is None else factor * headlight.left
