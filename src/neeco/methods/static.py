"""Nothing moves: plain 3D Gaussian splatting (Kerbl et al. 2023), method `3dgs`.

Learning rates, density control, opacity resets, SH orders and lambda = 0.2 are the source's. Departures, of every
method: the positions' rate falls to 3 % rather than 1 % (runs are shorter than 30,000 steps), and its unit is half the
median distance of the cameras from the scene; the number of Gaussians is limited (`max_tissue_gaussians`), strongest
gradients first, and large ones are not pruned by their size; the light may fall off with distance, as an endoscope's.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

from neeco.capture.model import State
from neeco.methods.breathing import BreathingTissue
from neeco.scene.canonical import CanonicalGaussians
from neeco.scene.deformation import UNPERTURBED, Deformation, Perturbation, Posed
from neeco.scene.drawable import ArticulatedMotion
from neeco.scene.method import PLAIN_TRAINING


class Static(BreathingTissue, Deformation):
    """The canonical Gaussians as they are, in every state; training may let them breathe to see what else moves."""

    method = "3dgs"
    training_defaults: ClassVar[Mapping[str, Any]] = {**PLAIN_TRAINING, "ssim_weight": 0.2}

    def pose(self, canonical: CanonicalGaussians, state: State, perturbation: Perturbation = UNPERTURBED) -> Posed:
        means = self.breathed(canonical.means, len(canonical), state.time)
        return Posed(means, canonical.quats, canonical.log_scales.exp())

    def motion(self, canonical: CanonicalGaussians) -> ArticulatedMotion:
        return ArticulatedMotion(canonical.log_scales, canonical.means.new_zeros(len(canonical), 0, 2), ())
