"""Positional encodings: one definition, in the orders in which the methods' sources write the numbers."""

from __future__ import annotations

import math

import torch
from torch import Tensor


def octave_angles(values: Tensor, count: int, unit: float = math.pi) -> Tensor:
    """Angles [..., D, L] rad, unit * 2^k * x for k < L = `count`, of values [..., D]."""
    return values[..., None] * (unit * 2.0 ** torch.arange(count, dtype=values.dtype, device=values.device))


def encode(values: Tensor, count: int, unit: float = math.pi) -> Tensor:
    """gamma: [..., D] to [..., 2 D L]: the sines of every coordinate's L = `count` octaves, then the cosines."""
    angles = octave_angles(values, count, unit).flatten(-2)
    return torch.cat([angles.sin(), angles.cos()], -1)


def encode_by_octave(values: Tensor, count: int, opened: Tensor | None = None) -> Tensor:
    """[..., D] to [..., D (1 + 2L)]: the values, then sin and cos of 2^k pi x octave by octave for k < L = `count`.

    `opened` in [0, L] is how many octaves let through; the next one in part (see `window`).
    """
    angles = octave_angles(values, count).transpose(-1, -2)  # [..., L, D]
    waves = torch.cat([angles.sin(), angles.cos()], -1)
    if opened is not None:
        waves = waves * window(opened, count)[:, None]
    return torch.cat([values, waves.flatten(-2)], -1)


def window(opened: Tensor, count: int) -> Tensor:
    """Weight [L] of each octave k < L = `count`: (1 - cos(pi clamp(opened - k, 0, 1))) / 2 (Nerfies eq. 5)."""
    octaves = torch.arange(count, device=opened.device)
    return (1 - torch.cos(math.pi * (opened - octaves).clamp(0, 1))) / 2
