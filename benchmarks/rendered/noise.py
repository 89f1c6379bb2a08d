"""Seeded procedural noise on square grids."""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from torch import Tensor


def value_noise(size: int, cells: float, generator: torch.Generator) -> Tensor:
    """Smooth noise [size, size], mean 0 and standard deviation 1, with about `cells` blobs along a side."""
    knots = max(4, math.ceil(cells) + 3)
    grid = torch.randn(1, 1, knots, knots, generator=generator)
    fine = F.interpolate(grid, size=(size, size), mode="bicubic", align_corners=True)[0, 0]
    return (fine - fine.mean()) / fine.std()


def octaves(size: int, cells: float, count: int, generator: torch.Generator, gain: float = 0.5) -> Tensor:
    """Fractal noise [size, size], mean 0 and standard deviation 1: `count` octaves, each `gain` times the one before.

    Octaves finer than three samples a blob are left out.
    """
    total = torch.zeros(size, size)
    for octave in range(count):
        if cells * 2**octave > size / 3:
            break
        total += gain**octave * value_noise(size, cells * 2**octave, generator)
    return (total - total.mean()) / total.std().clamp_min(1e-6)


def ridges(size: int, cells: float, width: float, generator: torch.Generator) -> Tensor:
    """Thin winding lines [size, size] in [0, 1], as vessels run: where warped noise crosses zero.

    `width`: of a line, as a share of a blob.
    """
    field = octaves(size, cells, 2, generator, 0.35)
    slope_y, slope_x = torch.gradient(field)
    # divide by the slope, or lines would swell wherever the noise is flat
    slope = (slope_x.square() + slope_y.square()).sqrt() * size / cells + 0.3
    return torch.exp(-(((field / slope) / width) ** 2))


def blur(image: Tensor, sigma: float) -> Tensor:
    """Gaussian blur of [H, W] or [C, H, W] by `sigma` samples, edges repeated."""
    if sigma <= 0:
        return image
    radius = math.ceil(3 * sigma)
    window = torch.exp(-0.5 * (torch.arange(-radius, radius + 1) / sigma) ** 2)
    window = window / window.sum()
    planes = image.reshape(-1, 1, *image.shape[-2:])
    planes = F.conv2d(F.pad(planes, (radius, radius, 0, 0), mode="replicate"), window[None, None, None, :])
    planes = F.conv2d(F.pad(planes, (0, 0, radius, radius), mode="replicate"), window[None, None, :, None])
    return planes.reshape(image.shape)
