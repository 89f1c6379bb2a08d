"""gsplat as a peer to measure against: it renders, plain torch evaluates the colours."""

from __future__ import annotations

import torch
from torch import Tensor

from neeco.geometry.camera import Camera
from neeco.raster.devices import constant
from neeco.raster.reference import camera_from_world, sh_colors
from neeco.raster.types import Gaussians


def color_by_gsplat(gaussians: Gaussians, camera: Camera) -> Tensor:
    """Colour [H, W, 3] through gsplat >= 1.4, float32, on the device of the means, depth rendered beside it."""
    from gsplat import rasterization

    device = gaussians.means.device
    camera = camera.to(device)
    pose = camera.world_from_camera.float()
    rotation, translation = camera_from_world(pose)
    last_row = constant((0.0, 0.0, 0.0, 1.0), device)[None]
    view = torch.cat([torch.cat([rotation, translation[:, None]], dim=1), last_row])  # camera_from_world
    intrinsics = constant((camera.fx, 0.0, camera.cx, 0.0, camera.fy, camera.cy, 0.0, 0.0, 1.0), device).view(3, 3)
    images, alphas, _ = rasterization(
        means=gaussians.means,
        quats=gaussians.quats,
        scales=gaussians.scales,
        opacities=gaussians.opacities,
        colors=sh_colors(gaussians.sh, gaussians.means, pose[:3, 3], gaussians.sh_frames).clamp(min=0),
        viewmats=view[None],
        Ks=intrinsics[None],
        width=camera.width,
        height=camera.height,
        near_plane=camera.near,
        render_mode="RGB+ED",
        packed=False,
    )
    color: Tensor = images[0, ..., :3]
    if gaussians.background is not None:
        color = color + (1 - alphas[0]) * gaussians.background.to(color)
    return color
