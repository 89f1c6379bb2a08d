"""Gaussians of an instrument that others hide in nearly every frame: nothing checked them, and they are dropped."""

from __future__ import annotations

import torch
from torch import Tensor

from neeco.capture.model import evenly_spaced
from neeco.scene.canonical import CanonicalGaussians
from neeco.scene.scene import Scene
from neeco.scene.visibility import visible_pixels

HIDDEN = 0.2  # of the pixels that a Gaussian takes up of its instrument drawn alone: less is left of it by the others
ASKED = 0.05  # px that it takes up there, in all frames together: below, its own instrument hides it
FRAMES = 64  # looked at, evenly spaced


def drop_hidden(scene: Scene) -> CanonicalGaussians:
    """The canonical Gaussians without those of instruments of which other bodies hide all but HIDDEN.

    Such are instruments' Gaussians inside another of the same arm, or in the tissue: drawn alone, they would widen the
    instrument.
    """
    canonical, recorded = scene.canonical, scene.recorded
    instruments = [canonical.bodies == body for body in range(1, len(canonical.counts))]  # bool [N] each
    left, whole = (torch.zeros_like(canonical.opacity_logits) for _ in range(2))
    for index in evenly_spaced(len(recorded.cameras), FRAMES):
        camera = recorded.cameras[index]
        with torch.no_grad():
            posed = scene.at(recorded.states[index])
        left += visible_pixels(posed, camera)
        for own in instruments:
            whole[own] += visible_pixels(posed.select(own), camera)
    kept = (canonical.bodies == 0) | (whole < ASKED) | (left >= HIDDEN * whole)
    return _only(canonical, kept)


def _only(canonical: CanonicalGaussians, kept: Tensor) -> CanonicalGaussians:
    counts = tuple(int(kept[canonical.body(body)].sum()) for body in range(len(canonical.counts)))
    return canonical.map(lambda tensor: tensor[kept], counts)
