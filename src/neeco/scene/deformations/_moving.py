"""Which Gaussians are the instrument, of a method that moves them without knowing: those whose place varies."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from torch import Tensor

from neeco.capture.model import Instrument, State
from neeco.scene.canonical import CanonicalGaussians
from neeco.scene.deformations.base import Deformation
from neeco.scene.training_session import GaussianTraining

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

    def finish(self, training: GaussianTraining) -> None:
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
    """Threshold that splits `values` [N] into two classes of greatest between-class variance (Otsu 1979); the middle
    of the gap between classes that lie apart."""
    low, high = float(values.min()), float(values.max())
    if not high > low:
        return high
    counts, edges = np.histogram(values.detach().cpu().double().numpy(), bins)
    below = np.cumsum(counts)[:-1].astype(float)
    above = counts.sum() - below
    sums = np.cumsum(counts * (edges[:-1] + edges[1:]) / 2)
    mean_below, mean_above = sums[:-1] / np.maximum(below, 1), (sums[-1] - sums[:-1]) / np.maximum(above, 1)
    between = below * above * (mean_below - mean_above) ** 2
    best = np.flatnonzero(between >= between.max() * (1 - 1e-9))  # a gap is a plateau
    return float(edges[1 + round(float(best.mean()))])
