"""Textures looked up at the size of a pixel's footprint: what is finer is averaged. Lengths mm, float32."""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from torch import Tensor

SHARP = 0.7  # looking up between texels and levels blurs, too
ROW = 1024  # OpenCV takes coordinates as images, of a limited width


@dataclass(frozen=True)
class Texture:
    """An image [S, S, C] with halved copies of itself.

    levels: 0 the finest, each [S_k, S_k, C], with a border of one texel repeated around where it is periodic; texel:
    size of those of level 0; origin: x and y of the corner of the first; period: 0 where the border's colour goes on.
    """

    levels: tuple[np.ndarray, ...]
    texel: float
    origin: float = 0.0
    period: float = 0.0

    @staticmethod
    def periodic(image: np.ndarray, period: float) -> Texture:
        """From an image [S, S, C] that repeats after `period` mm; S a power of two."""
        levels = tuple(np.pad(level, ((1, 1), (1, 1), (0, 0)), mode="wrap") for level in _halved(image, 8))
        return Texture(levels, period / len(image), 0.0, period)

    @staticmethod
    def patch(image: np.ndarray, texel: float, origin: float) -> Texture:
        """From an image [S, S, C] beyond which its border goes on."""
        return Texture(tuple(_halved(image, 150)), texel, origin)

    def look_up(self, x: Tensor, y: Tensor, footprint: Tensor) -> Tensor:
        """Values [M, C] at x, y [M], averaged over `footprint` [M] mm."""
        level = torch.log2((SHARP * footprint / self.texel).clamp_min(1e-6)).clamp(0, len(self.levels) - 1)
        u, v = (x - self.origin) / self.texel, (y - self.origin) / self.texel
        if self.period:
            count = self.period / self.texel
            u, v = torch.remainder(u, count), torch.remainder(v, count)
        finest, coarsest = math.floor(float(level.min())), math.ceil(float(level.max()))
        total = None
        for index in range(finest, coarsest + 1):
            shift = 0.5 if self.period else -0.5
            found = remap(self.levels[index], u / 2**index + shift, v / 2**index + shift)
            if finest == coarsest:
                return found
            found *= (1 - (level - index).abs()).clamp_min(0)[:, None]
            total = found if total is None else total + found
        assert total is not None
        return total


def remap(image: np.ndarray, u: Tensor, v: Tensor) -> Tensor:
    """Bilinear values [M, C] (or [M]) of an image [H, W, C] (or [H, W]) at texel coordinates u, v [M]: 0 is the middle
    of the first texel. Outside, the border's values."""
    count = len(u)
    rows = -(-count // ROW)
    places = torch.zeros(2, rows * ROW)
    places[0, :count], places[1, :count] = u, v
    grid = places.reshape(2, rows, ROW).numpy()
    found = cv2.remap(image, grid[0], grid[1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return torch.from_numpy(found).reshape(rows * ROW, *image.shape[2:])[:count]


def kept(wavelength: float, footprint: Tensor) -> Tensor:
    """Share [M] of a pattern's amplitude that pixels of `footprint` [M] mm resolve: all at four pixels a wave, none at
    two."""
    share = ((wavelength / footprint) / 2 - 1).clamp(0, 1)
    return share * share * (3 - 2 * share)


def _halved(image: np.ndarray, least: int) -> list[np.ndarray]:
    levels = [np.ascontiguousarray(image, dtype=np.float32)]
    while len(levels[-1]) // 2 >= least:
        half = len(levels[-1]) // 2
        smaller = cv2.resize(levels[-1], (half, half), interpolation=cv2.INTER_AREA)
        levels.append(smaller.reshape(half, half, -1).astype(np.float32, copy=False))
    return levels
