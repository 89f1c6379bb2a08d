"""Strong augmentation of a batch: geometry, light, colours, sharpness, noise, and cut-out.

The usual recipe of segmentation (Isensee et al., "nnU-Net", 2021), with cut-out (DeVries and Taylor, 2017).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional


@dataclass(frozen=True, kw_only=True)
class AugmentationSettings:
    """Maximum changes of an image, and their probabilities."""

    turn: float = 0.5  # rad
    zoom: float = 1.4  # maximum factor, enlarging or reducing
    shift: float = 0.15  # of a side
    exposure: float = 0.7  # octaves
    gamma: float = 0.6  # octaves
    tint: float = 0.2  # of each colour channel
    saturation: float = 0.5
    slope: float = 0.4  # of the brightness between opposite borders, as with other lamps
    blur: float = 1.5  # px
    blur_radius: int = 3  # px
    noise: float = 0.06
    cut: float = 0.35  # of a side
    placed: float = 0.5  # share of images with geometric changes
    relit: float = 0.7  # share of images with changed light and colours


CHANGES = AugmentationSettings()

Outline = tuple[int, np.ndarray]


def augment(planes: Tensor, rng: torch.Generator) -> tuple[Tensor, Tensor]:
    """Augment every image of a batch independently.

    planes [B, 3 + C + 1, h, w] in [0, 1]: colours, shares of classes, valid share. Labels move with the image; pixels
    from outside it are black, cut-out ones of one colour, and neither is valid. Returns the planes, and [B, 2, 3] that
    maps positions x, y in the augmented image to those in the original, both in [-1, 1] from side to side. rng: on the
    planes' device.
    """
    count, _, height, width = planes.shape
    device = planes.device

    def uniform(low: float, high: float, *shape: int) -> Tensor:  # [B, *shape] in [low, high)
        return low + (high - low) * torch.rand((count, *shape), generator=rng, device=device)

    def some(chance: float) -> Tensor:  # [B]: 1 with this probability, else 0
        return (uniform(0, 1) < chance).float()

    # flips, rotations, zooms and shifts [B, 2, 3]
    aspect = width / height
    placed = some(CHANGES.placed)
    flip = 1 - 2 * some(0.5)
    turn, zoom = placed * uniform(-CHANGES.turn, CHANGES.turn), CHANGES.zoom ** (placed * uniform(-1, 1))
    cosine, sine = turn.cos() / zoom, turn.sin() / zoom
    shift = placed[:, None] * uniform(-2 * CHANGES.shift, 2 * CHANGES.shift, 2)
    numbers = (cosine * flip, -sine / aspect, shift[:, 0], sine * aspect * flip, cosine, shift[:, 1])
    given_from_made = torch.stack(numbers, 1).reshape(-1, 2, 3)
    grid = functional.affine_grid(given_from_made, [count, 1, height, width], align_corners=False)
    planes = functional.grid_sample(planes, grid, align_corners=False)
    colors, labels = planes[:, :3], planes[:, 3:]
    relit = some(CHANGES.relit)[:, None, None, None] > 0  # in exposure, gamma, tint, saturation and lamps
    angle, slope = uniform(-math.pi, math.pi), some(0.5) * uniform(0, CHANGES.slope)
    across, down = (torch.linspace(-0.5, 0.5, side, device=colors.device) for side in (width, height))
    ramp = (slope * angle.cos())[:, None, None] * across + (slope * angle.sin())[:, None, None] * down[:, None]
    gain = 2 ** uniform(-CHANGES.exposure, CHANGES.exposure)
    tint = uniform(1 - CHANGES.tint, 1 + CHANGES.tint, 3) * gain[:, None]
    grey = colors.mean(1, keepdim=True)
    saturation = uniform(1 - CHANGES.saturation, 1 + CHANGES.saturation)
    lit = grey + (colors - grey) * saturation[:, None, None, None]
    lit = (lit * tint[..., None, None] * (1 + ramp[:, None])).clamp(1e-4, 1)
    lit = lit ** (2 ** uniform(-CHANGES.gamma, CHANGES.gamma))[:, None, None, None]
    colors = torch.where(relit, lit, colors)
    colors = _blur(colors, some(0.3) * uniform(0.2, CHANGES.blur))
    noise = torch.randn(colors.shape, generator=rng, device=device)
    strength = some(0.5) * uniform(0, CHANGES.noise)
    colors = (colors + noise * strength[:, None, None, None]).clamp(0, 1)
    inside, chosen = [], some(0.5) > 0  # a rectangle in every second image
    for side in (height, width):
        places = (torch.arange(side, device=device) + 0.5) / side
        inside.append((places - uniform(0, 1, 1)).abs() < uniform(0.1, CHANGES.cut, 1) / 2)
    cut = (inside[0][:, :, None] & inside[1][:, None] & chosen[:, None, None])[:, None]  # [B, 1, h, w]
    colors = torch.where(cut, uniform(0, 1, 3)[..., None, None], colors)
    valid = labels[:, -1:] * ~cut
    return torch.cat([colors, labels[:, :-1], valid], 1), given_from_made


def augment_batch(batch: Mapping[str, Any], rng: torch.Generator) -> dict[str, Tensor]:
    """Augment every image of a batch from `LabelledImages.collate` independently.

    Returns its image [B, 3, H, W], parts [B, H, W] and ignore [B, H, W], which includes pixels from outside an image
    and cut-out ones. Boxes, depth and other entries, which would no longer fit, are omitted. rng: on the images'
    device; the same state gives the same batch.
    """
    parts = batch["parts"].long()
    shares = functional.one_hot(parts, int(parts.max()) + 1).movedim(-1, 1)[:, 1:].float()
    valid = (~batch["ignore"])[:, None].float()
    planes, _ = augment(torch.cat([batch["image"], shares, valid], 1), rng)
    shares = planes[:, 3:-1]
    moved_parts = torch.cat([1 - shares.sum(1, keepdim=True), shares], 1).argmax(1).to(torch.uint8)
    return {"image": planes[:, :3], "parts": moved_parts, "ignore": planes[:, -1] < 0.5}


def moved(outlines: Sequence[Outline], given_from_made: np.ndarray) -> tuple[Outline, ...]:
    """Return outlines (class, [n, 2] in [0, 1]) in an augmented image, given its [2, 3], clipped to it."""
    linear = np.linalg.inv(given_from_made[:, :2])
    shift = (1 - linear @ (1 + given_from_made[:, 2])) / 2
    visible = []
    for number, points in outlines:
        placed = points @ linear.T + shift
        inside = placed[((placed >= 0) & (placed <= 1)).all(1)]
        if len(inside):
            visible.append((number, inside))
    return tuple(visible)


def _blur(colors: Tensor, deviations: Tensor) -> Tensor:
    """Blur each image [B, 3, h, w] by a Gaussian of its own standard deviation [B] px; 0: unchanged."""
    count = len(colors)
    radius = CHANGES.blur_radius
    offsets = torch.arange(-radius, radius + 1, device=colors.device)
    kernels = torch.exp(-0.5 * (offsets / deviations.clamp(min=1e-3)[:, None]) ** 2)  # [B, 7]
    kernels = (kernels / kernels.sum(1, keepdim=True)).repeat_interleave(3, 0)[:, None]  # [3 B, 1, 7]
    flat = functional.pad(colors.reshape(1, 3 * count, *colors.shape[2:]), (radius,) * 4, mode="replicate")
    flat = functional.conv2d(flat, kernels[:, :, None], groups=3 * count)
    return functional.conv2d(flat, kernels[..., None], groups=3 * count).reshape(colors.shape)
