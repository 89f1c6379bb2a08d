"""gsplat as a peer to measure against: it renders, plain torch evaluates the colours."""

from __future__ import annotations

import torch
from torch import Tensor

from neeco.geometry.camera import Camera
from neeco.raster.devices import constant
from neeco.raster.reference import camera_from_world, headlight_factor, sh_colors, usable_gaussians
from neeco.raster.types import Gaussians, Headlight, Rendering


def rasterize_gsplat(
    gaussians: Gaussians, camera: Camera, channels: Tensor | None = None, background: Tensor | None = None
) -> Rendering:
    """`rasterize` of a pinhole without shadows through gsplat >= 1.4, float32, on the device of the means.

    gsplat does not define the order of equal depths; everything else follows the reference to float32 accuracy.
    """
    from gsplat import rasterization

    n, device = len(gaussians), gaussians.means.device
    empty = torch.zeros(n, 2, device=device, requires_grad=torch.is_grad_enabled())
    camera = camera.to(device)
    index = usable_gaussians(gaussians, camera, channels).nonzero()[:, 0]
    pose = camera.world_from_camera.float()
    rotation, translation = camera_from_world(pose)
    if len(index) == 0:
        return _empty_rendering(camera, channels, background, empty)
    means = gaussians.means[index].float()
    frames = None if gaussians.sh_frames is None else gaussians.sh_frames[index].float()
    values = sh_colors(gaussians.sh[index].float(), means, pose[:3, 3], frames).clamp(min=0)
    if gaussians.headlight is not None:
        lit = gaussians.headlight
        left = None if lit.left is None else lit.left[index].float()
        light = Headlight(lit.falloff[index].float(), lit.vignette.float(), left=left)
        values = values * headlight_factor(light, camera, means @ rotation.T + translation)[:, None]
    if channels is not None:
        values = torch.cat([values, channels[index].float()], dim=-1)

    last_row = constant((0.0, 0.0, 0.0, 1.0), device)[None]
    view = torch.cat([torch.cat([rotation, translation[:, None]], dim=1), last_row])  # camera_from_world
    intrinsics = constant((camera.fx, 0.0, camera.cx, 0.0, camera.fy, camera.cy, 0.0, 0.0, 1.0), device).view(3, 3)
    images, alphas, info = rasterization(
        means=means,
        quats=gaussians.quats[index].float(),
        scales=gaussians.scales[index].float(),
        opacities=gaussians.opacities[index].float(),
        colors=values,
        viewmats=view[None],
        Ks=intrinsics[None],
        width=camera.width,
        height=camera.height,
        near_plane=camera.near,
        render_mode="RGB+ED",
        packed=False,
    )
    alpha = alphas[0, ..., 0]
    color = images[0, ..., :3]
    if background is not None:
        color = color + (1 - alpha)[..., None] * background.to(color)
    depth = torch.where(alpha > 0, images[0, ..., -1], 0.0)
    radii = torch.zeros(n, device=device)
    radii[index] = _largest(info["radii"][0]).float()
    offsets = _center_gradients(info["means2d"], index, empty)
    return Rendering(color, alpha, depth, None if channels is None else images[0, ..., 3:-1], radii, offsets)


def _largest(radii: Tensor) -> Tensor:
    """Return one radius per Gaussian: gsplat gives one up to version 1.4 and one per axis from 1.5 on."""
    return radii.amax(dim=-1) if radii.dim() == 2 else radii


def _center_gradients(centers: Tensor, index: Tensor, offsets: Tensor) -> Tensor:
    """Let `offsets.grad` receive the gradient of gsplat's projected centres [1, M, 2] when it is computed."""
    if centers.requires_grad:

        def receive(gradient: Tensor) -> None:
            full = torch.zeros_like(offsets)
            full[index] = gradient.reshape(-1, 2)
            offsets.grad = full if offsets.grad is None else offsets.grad + full

        centers.register_hook(receive)
    return offsets


def _empty_rendering(camera: Camera, channels: Tensor | None, background: Tensor | None, offsets: Tensor) -> Rendering:
    blank = torch.zeros(camera.height, camera.width, device=offsets.device)
    color = blank[..., None].expand(-1, -1, 3)
    if background is not None:
        color = color + background.to(color)
    composited = None if channels is None else blank[..., None].expand(-1, -1, channels.shape[1])
    return Rendering(color, blank, blank, composited, torch.zeros(len(offsets), device=offsets.device), offsets)
