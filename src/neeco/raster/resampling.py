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
from torch.nn.functional import embedding_bag, grid_sample

from neeco.geometry.camera import Camera
from neeco.geometry.distortion import field_pinhole, lens_field
from neeco.raster.reference import LOW_PASS
from neeco.raster.types import Gaussians, Layer, Rendering

ORIGIN = torch.eye(4)  # one tensor, so that cameras there are equal when their intrinsics are
OUTSIDE = 2.0  # a `grid_sample` coordinate outside the image

Draw = Callable[[Camera], Rendering]


def draw_through(camera: Camera, draw: Draw) -> Rendering:
    """Render for `camera`, which has a lens or a size other than the learned one; `draw` renders pinholes of the
    learned size or larger.

    A size smaller than learned is the learned one, averaged over the area of each pixel. A lens is rendered by a
    pinhole whose field contains the lens's, and sampled bilinearly; beyond border and field the image is empty.
    """
    fine = of_rendered_size(camera)
    source = field_pinhole(fine)
    rendering = draw(source)
    if camera.is_pinhole and (fine.width, fine.height) == (camera.width, camera.height):
        return rendering
    layers = Layer(rendering.alpha, rendering.depth), *rendering.alone
    planes = [
        rendering.color,
        *(plane[..., None] for each in layers for plane in (each.alpha, each.depth * each.alpha)),
    ]
    planes += [] if rendering.channels is None else [rendering.channels]
    image = resampled(torch.cat(planes, -1), source, fine, camera)
    end = 3 + 2 * len(layers)
    (alpha, weighted), *alone = image[..., 3:end].unflatten(-1, (-1, 2)).permute(2, 3, 0, 1)
    return replace(
        rendering,
        color=image[..., :3],
        alpha=alpha,
        depth=_divided(weighted, alpha),
        channels=None if rendering.channels is None else image[..., end:],
        alone=tuple(Layer(alpha, _divided(weighted, alpha)) for alpha, weighted in alone),
    )


def _divided(weighted: Tensor, alpha: Tensor) -> Tensor:
    """Return depths [H, W] from their sums weighted by alpha [H, W]; 0 where that is 0."""
    return torch.where(alpha > 0, weighted / alpha.clamp_min(torch.finfo(alpha.dtype).tiny), 0.0)


def learned_scale(camera: Camera) -> float:
    """Return the camera's pixels per learned pixel, along each side."""
    return 1.0 if camera.learned_fx is None else camera.fx / camera.learned_fx


def of_rendered_size(camera: Camera) -> Camera:
    """Return the camera to render, at least of the learned size."""
    return of_learned_size(camera) if learned_scale(camera) < 1 else camera


def widened(gaussians: Gaussians, camera: Camera) -> Gaussians:
    """Return the Gaussians for a pinhole larger than learned, which magnifies the learned image.

    The backends' low-pass is constant in pixels, which are smaller now; the rest is added to the Gaussians' size,
    isotropically, as by Mip-Splatting's 3D filter (Yu et al. 2024, eq. 7).
    """
    scale = learned_scale(camera)
    if scale <= 1:
        return gaussians
    pose = camera.world_from_camera.to(gaussians.means)
    offsets = (gaussians.means - pose[:3, 3]) * pose[:3, 2]  # a matrix product may round by how many there are
    depths = offsets.sum(1).clamp_min(camera.near)
    lacking = LOW_PASS * (scale**2 - 1) * (depths / camera.fx).square()  # [N] mm^2
    return replace(gaussians, scales=(gaussians.scales.square() + lacking[:, None]).sqrt())


def of_learned_size(camera: Camera) -> Camera:
    """Return the camera with approximately the learned number of pixels, to be rendered directly."""
    scale = learned_scale(camera)
    resized = camera.resized(*(max(1, round(size / scale)) for size in (camera.width, camera.height)))
    return replace(resized, learned_fx=None)


def resampled(image: Tensor, source: Camera, fine: Camera, camera: Camera) -> Tensor:
    """Resample an image [H, W, C] of the pinhole `source` for `camera`, by the pixels of `fine`, which has the same
    lens; 0 outside the image."""
    if not fine.is_pinhole:
        pinhole = (source.fx, source.fy), (source.cx, source.cy), (source.width, source.height)
        grid = _sampling_grid(replace(fine, world_from_camera=ORIGIN), pinhole)
        planes = grid_sample(image.permute(2, 0, 1)[None], grid.to(image), align_corners=False)
        image = planes[0].permute(1, 2, 0).contiguous()
    sizes = (fine.width, fine.height), (camera.width, camera.height)
    if sizes[0] == sizes[1]:
        return image
    pixels, shares = (table.to(image.device) for table in _covered_pixels(*sizes))
    reduced = embedding_bag(pixels, image.flatten(0, 1), per_sample_weights=shares.to(image), mode="sum")
    return reduced.view(camera.height, camera.width, -1)


@lru_cache(maxsize=4)
def _covered_pixels(size: tuple[int, int], reduced: tuple[int, int]) -> tuple[Tensor, Tensor]:
    """Return, for every pixel of an image reduced from one `size` (width, height) to another, the pixels [h w, K] of
    the larger one that it covers, row by row, and the share [h w, K] of its area in each."""
    (columns, across), (rows, down) = (_covered(*ends) for ends in zip(size, reduced, strict=True))
    pixels = rows[:, None, :, None] * size[0] + columns[None, :, None, :]
    shares = down[:, None, :, None] * across[None, :, None, :]
    many = reduced[0] * reduced[1]
    return pixels.reshape(many, -1), shares.reshape(many, -1)


def _covered(many: int, few: int) -> tuple[Tensor, Tensor]:
    """`_covered_pixels` along one side: [few, K] both."""
    ratio = many / few
    start = torch.arange(few, dtype=torch.float64)[:, None] * ratio
    pixels = start.floor() + torch.arange(math.ceil(ratio) + 1)
    shares = (torch.minimum(pixels + 1, start + ratio) - torch.maximum(pixels, start)).clamp_min(0) / ratio
    used = (shares > 1e-9).any(0)  # the last column is often unused
    return pixels[:, used].clamp_max(many - 1).long(), shares[:, used].float()


@lru_cache(maxsize=4)
def _sampling_grid(lens: Camera, pinhole: tuple[tuple[float, float], ...]) -> Tensor:
    """Return the positions [1, H, W, 2], for `grid_sample`, of the pixels of `lens`, a camera at ORIGIN, in the image
    of a pinhole of these focal lengths, principal point and size."""
    focal, center, size = (np.array(pair, np.float32) for pair in pinhole)
    place = lens_field(lens).slopes * focal + center
    return torch.from_numpy(np.nan_to_num(2 * place / size - 1, nan=OUTSIDE))[None]
