"""Images of another size than Gaussians were learned at, or seen through a lens.

The backends know pinholes of the learned size. Everything else is drawn by such a pinhole and resampled: colour, alpha,
depth and channels alike, so that labels are decided by what the pixels then hold.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, grid_sample

from neeco.geometry.camera import Camera
from neeco.geometry.distortion import field_pinhole, lens_field
from neeco.raster.reference import LOW_PASS
from neeco.raster.types import Gaussians, Rendering

# Of the learned size: from here up the backends' own low-pass is near enough. Measured at .9: .1 dB less than averaged.
COARSE = 0.9
ORIGIN = torch.eye(4)  # one tensor, so that cameras there are equal when their numbers are
NOWHERE = 2.0  # in the coordinates of `grid_sample`, beyond the image

Draw = Callable[[Camera], Rendering]


def draw_through(camera: Camera, draw: Draw) -> Rendering:
    """What `camera`, which has a lens or a size other than the learned one, sees; `draw` draws for pinholes of its
    learned size or larger.

    Smaller than learned, a whole number of times as many pixels are drawn along each side, and averaged. Through a
    lens, a pinhole is drawn whose field holds the lens's, and sampled bilinearly; beyond border and field there is
    nothing.
    """
    fine = supersampled(camera)
    seen = field_pinhole(fine)
    rendering = draw(seen)
    if fine is camera and camera.is_pinhole:
        return rendering
    alpha = rendering.alpha[..., None]
    planes = [rendering.color, alpha, rendering.depth[..., None] * alpha]
    planes += [] if rendering.channels is None else [rendering.channels]
    found = resampled(torch.cat(planes, -1), seen, fine, camera)
    alpha = found[..., 3]
    return replace(
        rendering,
        color=found[..., :3],
        alpha=alpha,
        depth=torch.where(alpha > 0, found[..., 4] / alpha.clamp_min(torch.finfo(alpha.dtype).tiny), 0.0),
        channels=None if rendering.channels is None else found[..., 5:],
    )


def learned_scale(camera: Camera) -> float:
    """How many of the camera's pixels there are to a learned one, along each side."""
    return 1.0 if camera.learned_fx is None else camera.fx / camera.learned_fx


def supersampled(camera: Camera) -> Camera:
    """The camera with the pixels that are drawn, a whole number along each side of each of the image's."""
    scale = learned_scale(camera)
    times = math.ceil(1 / scale - 1e-6) if scale < COARSE else 1
    return camera if times == 1 else camera.resized(times * camera.width, times * camera.height)


def widened(gaussians: Gaussians, camera: Camera) -> Gaussians:
    """The Gaussians as a pinhole larger than learned is to draw them: the picture that was learned, seen larger.

    The backends' low-pass is a number of pixels, smaller ones now; what it lacks, Gaussians are given as a size,
    isotropically, as by Mip-Splatting's 3D filter (Yu et al. 2024, eq. 7).
    """
    scale = learned_scale(camera)
    if scale <= 1:
        return gaussians
    pose = camera.world_from_camera.to(gaussians.means)
    depths = ((gaussians.means - pose[:3, 3]) @ pose[:3, 2]).clamp_min(camera.near)
    lacking = LOW_PASS * (scale**2 - 1) * (depths / camera.fx).square()  # [N] mm^2
    return replace(gaussians, scales=(gaussians.scales.square() + lacking[:, None]).sqrt())


def of_learned_size(camera: Camera) -> Camera:
    """The pinhole with pixels as many as were learned from, or nearly."""
    scale = learned_scale(camera)
    return camera.resized(*(max(1, round(size / scale)) for size in (camera.width, camera.height)))


def resampled(image: Tensor, seen: Camera, fine: Camera, camera: Camera) -> Tensor:
    """An image [H, W, C] that the pinhole `seen` sees, as `camera` sees it by way of the pixels of `fine`, of which it
    has a whole number along each side of each of its own; 0 where it sees nothing of it."""
    planes = image.permute(2, 0, 1)[None]
    if not fine.is_pinhole:
        pinhole = (seen.fx, seen.fy), (seen.cx, seen.cy), (seen.width, seen.height)
        grid = _sampling_grid(replace(fine, world_from_camera=ORIGIN), pinhole)
        planes = grid_sample(planes, grid.to(planes), align_corners=False)
    if fine.width != camera.width:
        planes = avg_pool2d(planes, fine.width // camera.width)
    return planes[0].permute(1, 2, 0).contiguous()


@lru_cache(maxsize=4)
def _sampling_grid(lens: Camera, pinhole: tuple[tuple[float, float], ...]) -> Tensor:
    """[1, H, W, 2] where the pixels of `lens`, a camera at ORIGIN, lie in the image of a pinhole of these focal
    lengths, principal point and size, as `grid_sample` takes it."""
    focal, center, size = (np.array(pair, np.float32) for pair in pinhole)
    place = lens_field(lens).slopes * focal + center
    return torch.from_numpy(np.nan_to_num(2 * place / size - 1, nan=NOWHERE))[None]
