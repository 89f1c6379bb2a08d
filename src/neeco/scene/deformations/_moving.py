"""Which Gaussians are the instrument, of a method that moves them without knowing: those whose place varies."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from neeco.capture.model import Instrument, State
from neeco.scene.canonical import CanonicalGaussians
from neeco.scene.deformations.base import Deformation
from neeco.scene.learning import Training

MEMBERSHIP = "membership"  # the per-Gaussian extra [N] in {0, 1} that `mark_moving` stores
STILL = 1e-6  # mm; what moves less does not move
EVERY = 4  # recorded states between those looked at


class LabelledByMotion(Deformation):
    """One label column, "instrument", for all instruments together (none without any): what moves once all is
    learned."""

    def __init__(self, instruments: tuple[Instrument, ...], settings: Any = None) -> None:
        super().__init__(instruments, settings)
        self.label_names = (("+".join(i.name for i in instruments), "instrument"),) if instruments else ()

    def label_channels(self, canonical: CanonicalGaussians) -> Tensor:
        """The moving Gaussians [N, len(label_names)] as found by `finish`; nothing before that."""
        if MEMBERSHIP not in canonical.extras or not self.label_names:
            return super().label_channels(canonical)
        return canonical.extras[MEMBERSHIP][:, None]

    def finish(self, training: Training) -> None:
        scene = training.scene
        if self.instruments:
            scene.canonical = mark_moving(self, scene.canonical, list(scene.recorded.states[::EVERY]))


@torch.no_grad()
def mark_moving(deformation: Deformation, canonical: CanonicalGaussians, states: list[State]) -> CanonicalGaussians:
    """Store which Gaussians move over the recorded states [N] in {0, 1}: spread of d_mu above Otsu's threshold of its
    logarithm."""
    moved = torch.stack([deformation.deltas(canonical, state).means for state in states])  # [F, N, 3]
    spread = (moved - moved.mean(0)).square().sum(-1).mean(0).sqrt()
    size = spread.clamp_min(STILL).log()
    evaluated = spread > STILL  # those behind the gate would be a second cluster of their own
    threshold = otsu(size[evaluated]) if evaluated.any() else math.inf
    return canonical.with_extras(**{MEMBERSHIP: (size > threshold).float()})


def otsu(values: Tensor, bins: int = 256) -> float:
    """Threshold that splits `values` [N] into two classes of greatest between-class variance (Otsu 1979)."""
    low, high = float(values.min()), float(values.max())
    if not high > low:
        return high
    counts = torch.histc(values.float(), bins, low, high)
    centers = low + (torch.arange(bins, device=values.device) + 0.5) * (high - low) / bins
    weight = counts.cumsum(0) / counts.sum()
    mean = (counts * centers).cumsum(0) / counts.sum()
    between = (mean[-1] * weight - mean).square() / (weight * (1 - weight)).clamp_min(1e-9)
    return float(centers[between[:-1].argmax()] + (high - low) / (2 * bins))
