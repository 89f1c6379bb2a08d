"""A Gaussian blur whose width is learned."""

from __future__ import annotations

import torch
from torch import Tensor

TAPS = 6  # pixels to each side of the window's middle, which is cut off there
LEAST = 0.3  # px: a narrower window is drawn as wide as this


def blur(image: Tensor, sigma: Tensor) -> Tensor:
    """`image` [H, W] under a Gaussian window of standard deviation `sigma` [] px, cut off after TAPS pixels; nothing
    comes from beyond the image. Any float type and device; gradients reach both."""
    down, across = (_window_matrix(size, sigma) for size in image.shape)
    return down @ image @ across


def _window_matrix(size: int, sigma: Tensor) -> Tensor:
    """[size, size] that blurs a line of pixels; its middle row sums to 1."""
    places = torch.arange(size, dtype=sigma.dtype, device=sigma.device)
    steps = (places[:, None] - places).abs()
    weights = torch.exp(-0.5 * (steps / sigma.clamp_min(LEAST)).square()) * (steps <= TAPS)
    return weights / weights[size // 2].sum()
