"""Nothing moves: plain 3D Gaussian splatting (Kerbl et al. 2023), method `3dgs`."""

from __future__ import annotations

from neeco.capture.model import Instrument, State
from neeco.scene.canonical import CanonicalGaussians
from neeco.scene.deformations.base import UNPERTURBED, Deformation, Perturbation, Posed


class Static(Deformation):
    """The canonical Gaussians as they are, in every state."""

    def __init__(self, instruments: tuple[Instrument, ...]) -> None:
        super().__init__()

    def pose(self, canonical: CanonicalGaussians, state: State, perturbation: Perturbation = UNPERTURBED) -> Posed:
        return Posed(canonical.means, canonical.quats, canonical.log_scales.exp())
