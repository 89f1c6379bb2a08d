"""Resampling of images of another size than the learned one, or through a lens with distortion.

The backends render pinholes of the learned size. Everything else is rendered by such a pinhole and resampled: colour,
alpha, depth and channels, so that labels follow the resampled pixels.
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
from neeco.raster.types import Gaussians, Layer, Rendering

# Scale from which the backends' own low-pass replaces supersampling. Measured at 0.9: 0.1 dB less than averaged.
MIN_DIRECT_SCALE = 0.9
ORIGIN = torch.eye(4)  # one tensor, so that cameras there are equal when their intrinsics are
OUTSIDE = 2.0  # in the coordinates of `grid_sample`, beyond the image

Draw = Callable[[Camera], Rendering]


def draw_through(camera: Camera, draw: Draw) -> Rendering:
    """Render for `camera`, which has a lens or a size other than the learned one; `draw` renders pinholes of the
    learned size or larger.

    Sizes smaller than learned are supersampled by a whole number along each side, and averaged. A lens is rendered by
    a pinhole whose field contains the lens's, and sampled bilinearly; beyond border and field the image is empty.
    """
    fine = supersampled(camera)
    source = field_pinhole(fine)
    rendering = draw(source)
    if fine is camera and camera.is_pinhole:
        return rendering
    alpha = rendering.alpha[..., None]
    planes = [rendering.color, alpha, rendering.depth[..., None] * alpha]
    planes += [] if rendering.channels is None else [rendering.channels]
    found = resampled(torch.cat(planes, -1), source, fine, camera)
    layers = [
        resampled(torch.stack([layer.alpha, layer.depth * layer.alpha], -1), source, fine, camera)
        for layer in rendering.alone
    ]
    return replace(
        rendering,
        color=found[..., :3],
        alpha=found[..., 3],
        depth=_divided(found[..., 4], found[..., 3]),
        channels=None if rendering.channels is None else found[..., 5:],
        alone=tuple(Layer(layer[..., 0], _divided(layer[..., 1], layer[..., 0])) for layer in layers),
    )


def _divided(weighted: Tensor, alpha: Tensor) -> Tensor:
    """Return depths [H, W] from their sums weighted by alpha [H, W]; 0 where that is 0."""
    return torch.where(alpha > 0, weighted / alpha.clamp_min(torch.finfo(alpha.dtype).tiny), 0.0)


def learned_scale(camera: Camera) -> float:
    """Return the camera's pixels per learned pixel, along each side."""
    return 1.0 if camera.learned_fx is None else camera.fx / camera.learned_fx


def supersampled(camera: Camera) -> Camera:
    """Return the camera of the rendered pixels, a whole number per pixel of the image along each side."""
    scale = learned_scale(camera)
    times = math.ceil(1 / scale - 1e-6) if scale < MIN_DIRECT_SCALE else 1
    return camera if times == 1 else camera.resized(times * camera.width, times * camera.height)


def widened(gaussians: Gaussians, camera: Camera) -> Gaussians:
    """Return the Gaussians for a pinhole larger than learned, which magnifies the learned image.

    The backends' low-pass is constant in pixels, which are smaller now; the rest is added to the Gaussians' size,
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
    """Return the pinhole with approximately the learned number of pixels."""
    scale = learned_scale(camera)
    return camera.resized(*(max(1, round(size / scale)) for size in (camera.width, camera.height)))


def resampled(image: Tensor, source: Camera, fine: Camera, camera: Camera) -> Tensor:
    """Resample an image [H, W, C] of the pinhole `source` for `camera`, by the supersampled pixels of `fine`; 0 outside
    the image."""
    planes = image.permute(2, 0, 1)[None]
    if not fine.is_pinhole:
        pinhole = (source.fx, source.fy), (source.cx, source.cy), (source.width, source.height)
        grid = _sampling_grid(replace(fine, world_from_camera=ORIGIN), pinhole)
        planes = grid_sample(planes, grid.to(planes), align_corners=False)
    if fine.width != camera.width:
        planes = avg_pool2d(planes, fine.width // camera.width)
    return planes[0].permute(1, 2, 0).contiguous()


@lru_cache(maxsize=4)
def _sampling_grid(lens: Camera, pinhole: tuple[tuple[float, float], ...]) -> Tensor:
    """Return the positions [1, H, W, 2], for `grid_sample`, of the pixels of `lens`, a camera at ORIGIN, in the image
    of a pinhole of these focal lengths, principal point and size."""
    focal, center, size = (np.array(pair, np.float32) for pair in pinhole)
    place = lens_field(lens).slopes * focal + center
    return torch.from_numpy(np.nan_to_num(2 * place / size - 1, nan=OUTSIDE))[None]
