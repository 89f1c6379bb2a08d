"""Evidence made clearer by colour: pixels like those with evidence count, and those that look like tissue do not.

A short fit of the tissue takes a dark shaft in part for tissue, and is wrong about the tissue beside an instrument.
Over all frames together colours tell the two apart.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, avg_pool3d, pad

from neeco.scene.training_views import TrainingViews
from neeco.training.instruments.evidence import Evidence

LIGHT_BINS, HUE_BINS = 24, 48  # of brightness (its root), and of either share of red and green
ROUNDS = 2  # of which the later ones begin with the clearer evidence
SMOOTHING = 5  # px across which pixels are alike
NEAR, NEAR_SHARE = 15, 0.25  # px about a pixel, and share of evidence in them from which it counts in full
DARK = 0.05  # added to the sum of the colours, so that black has no hue


@torch.no_grad()
def clear_by_color(evidence: Evidence, views: TrainingViews) -> Evidence:
    """Evidence [F, H, W] of frames of `views` as the share of pixels of a colour that are of the instruments, were they
    as frequent as the others, where there was evidence nearby."""
    index = {frame.name: i for i, frame in enumerate(views.frames)}
    height, width = evidence.hits.shape[1:]
    bins, counted = [], []
    for frame in evidence.frames:
        image, mask = views.target(index[frame.name]), views.mask(index[frame.name])
        room = (0, width - image.shape[1], 0, height - image.shape[0])
        inside = torch.ones_like(image[..., 0]) if mask is None else mask.to(image)
        bins.append(pad(_bins(image), room))
        counted.append(pad(inside, room))
    places, known = torch.stack(bins), torch.stack(counted)
    hits = evidence.hits
    near = (_blurred(evidence.hits, NEAR) / NEAR_SHARE).clamp(0, 1)
    for _ in range(ROUNDS):
        own, other = _density(places, hits * known), _density(places, (1 - hits) * known)
        likely = own / (own + other).clamp_min(1e-12)
        hits = _blurred(likely[places] * known, SMOOTHING) * near
    return replace(evidence, hits=hits)


def _bins(image: Tensor) -> Tensor:
    """[H, W] the histogram's bin of every pixel of an image [H, W, 3] in [0, 1]."""
    total = image.sum(-1)
    light = ((total / 3).clamp_min(0).sqrt() * LIGHT_BINS).long().clamp(0, LIGHT_BINS - 1)
    red, green = ((image[..., k] / (total + DARK) * HUE_BINS).long().clamp(0, HUE_BINS - 1) for k in (0, 1))
    return (light * HUE_BINS + red) * HUE_BINS + green


def _density(places: Tensor, weights: Tensor) -> Tensor:
    """[bins] share of the weights in every bin and those beside it."""
    flat = torch.bincount(places.flatten(), weights.flatten().double(), LIGHT_BINS * HUE_BINS**2)
    cube = flat.reshape(1, 1, LIGHT_BINS, HUE_BINS, HUE_BINS)
    return (avg_pool3d(cube, 3, 1, 1).flatten() / flat.sum().clamp_min(1e-9)).to(weights)


def _blurred(images: Tensor, side: int) -> Tensor:
    """[F, H, W] means over squares of `side` px."""
    return avg_pool2d(images[:, None], side, 1, side // 2)[:, 0]
