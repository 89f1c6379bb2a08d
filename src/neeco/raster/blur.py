"""A Gaussian blur whose width is learned: its definition for any device, and a native kernel."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from neeco.raster.native import all_native, native

TAPS = 6  # pixels to each side of the window's middle, which is cut off there
LEAST = 0.3  # px: a narrower window is drawn as wide as this


def blur(image: Tensor, sigma: Tensor) -> Tensor:
    """`image` [H, W] under a Gaussian window of standard deviation `sigma` [] px, cut off after TAPS pixels; nothing
    comes from beyond the image. The gradient reaches sigma, not the image. float32 on the CPU takes the native kernel.
    """
    image = image.detach()
    if not all_native(image):
        return blur_reference(image, sigma)
    return _Blur.apply(image, sigma)


def blur_reference(image: Tensor, sigma: Tensor) -> Tensor:
    """`blur` in plain torch, any float type and device; the gradient reaches the image too."""
    down, across = (_window_matrix(size, sigma) for size in image.shape)
    return down @ image @ across


def _window_matrix(size: int, sigma: Tensor) -> Tensor:
    """[size, size] that blurs a line of pixels; its middle row sums to 1."""
    places = torch.arange(size, dtype=sigma.dtype, device=sigma.device)
    steps = (places[:, None] - places).abs()
    weights = torch.exp(-0.5 * (steps / sigma.clamp_min(LEAST)).square()) * (steps <= TAPS)
    return weights / weights[size // 2].sum()


def _window(size: int, sigma: float) -> tuple[list[float], list[float]]:
    """The window of a line of `size` pixels, 2 TAPS + 1 numbers, and its derivatives by sigma."""
    wide = max(sigma, LEAST)
    weights = [math.exp(-0.5 * (k / wide) ** 2) for k in range(-TAPS, TAPS + 1)]
    slopes = [w * k * k / wide**3 * (sigma >= LEAST) for k, w in zip(range(-TAPS, TAPS + 1), weights, strict=True)]
    reached = slice(max(0, TAPS - size // 2), TAPS + size - size // 2)  # by the line's middle
    total, growth = sum(weights[reached]), sum(slopes[reached])
    return [w / total for w in weights], [
        (s - w * growth / total) / total for w, s in zip(weights, slopes, strict=True)
    ]


class _Blur(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, image: Tensor, sigma: Tensor) -> Tensor:
        windows, slopes = zip(*(_window(size, float(sigma)) for size in image.shape), strict=True)
        out = image.new_empty(image.shape)
        slope = image.new_empty(image.shape) if ctx.needs_input_grad[1] else None
        native().blur(image.contiguous(), torch.tensor(windows), torch.tensor(slopes), out, slope)
        if slope is not None:
            ctx.save_for_backward(slope)
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> Any:
        (slope,) = ctx.saved_tensors
        return None, (gradients[0] * slope).sum()
