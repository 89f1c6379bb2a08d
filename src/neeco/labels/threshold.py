"""The paper's labels: what moves is the instrument.

Gaussians whose deltas exceed thresholds are drawn alone on black, and what is not black is the mask. Knows neither
parts nor what stands in front of the instrument.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from neeco.capture.model import State
from neeco.errors import NeecoError
from neeco.raster import rasterize
from neeco.raster.types import Camera, Gaussians, Rendering
from neeco.scene.deformations.base import otsu

if TYPE_CHECKING:
    from neeco.scene import Scene

BLACK = 0.1  # RGB magnitude (norm) above which a pixel of the instrument drawn alone is the instrument
THRESHOLD_STATES = 24  # recorded states that Otsu's method looks at
DELTAS = ("means", "quats", "scales")


@dataclass(frozen=True)
class DeltaThresholds:
    """Magnitudes above which a Gaussian counts as moved: position (mm), rotation (quaternion), scale (mm).

    A kind of delta that never differs between Gaussians says nothing and has no threshold.
    """

    means: float | None
    quats: float | None
    scales: float | None

    def moved(self, magnitudes: dict[str, Tensor]) -> Tensor:
        """[N] bool: which Gaussians exceed every threshold there is."""
        tests = [magnitudes[kind] > limit for kind, limit in vars(self).items() if limit is not None]
        return torch.stack(tests).all(dim=0)


class ThresholdLabels:
    """The labeller (see `drawing.Labeller`) that goes by deltas.

    The paper knows one instrument. Where the scene has several, a moved Gaussian is the nearest instrument's.
    """

    def __init__(self, scene: Scene, thresholds: DeltaThresholds | None = None, black: float = BLACK) -> None:
        instruments = tuple(instrument.name for instrument in scene.instruments)
        if not instruments:
            raise NeecoError("scene: --labels threshold needs a scene with instruments; this one was trained without")
        self.names = tuple((name, "instrument") for name in instruments)
        self.scene = scene
        self.black = black
        self.thresholds = thresholds or find_thresholds(scene)

    def owners(self, state: State, posed: Gaussians) -> Tensor:
        """[N] the instrument nearest to a Gaussian that moved, -1 for one that did not."""
        moved = self.thresholds.moved(delta_magnitudes(self.scene, state))
        means = posed.means
        origins = torch.stack(
            [
                state.instruments[name].pose[:3, 3].to(means)
                if name in state.instruments
                else means.new_full((3,), torch.inf)
                for name, _ in self.names
            ]
        )
        return torch.where(moved, torch.cdist(means, origins).argmin(dim=1), -1)

    def draw(
        self, gaussians: Gaussians, camera: Camera, owners: Tensor, unobserved: Tensor | None = None
    ) -> tuple[Rendering, Tensor, Tensor]:
        """Colour of the whole scene; ids and share (the alpha) from the moved Gaussians drawn alone."""
        moved = owners >= 0
        shares = torch.nn.functional.one_hot(owners[moved], len(self.names)).to(gaussians.means)
        alone = rasterize(gaussians.select(moved), camera, channels=shares)
        assert alone.channels is not None
        ids = alone.channels.argmax(dim=2) + 1
        lit = alone.color.norm(dim=2) > self.black
        rendering = rasterize(gaussians, camera, channels=None if unobserved is None else unobserved[:, None])
        return rendering, torch.where(lit, ids, 0).to(torch.uint8), alone.alpha


@torch.no_grad()
def delta_magnitudes(scene: Scene, state: State) -> dict[str, Tensor]:
    """How far `state` moves each Gaussian from canonical: norms [N] of the deltas of "means", "quats", "scales"."""
    deltas = scene.deltas(state)
    return {kind: getattr(deltas, kind).norm(dim=1) for kind in DELTAS}


def find_thresholds(scene: Scene) -> DeltaThresholds:
    """Thresholds by Otsu's method on the deltas' log-magnitude over recorded states (the paper leaves them open).

    Raises NeecoError when no kind of delta tells Gaussians apart, as in a scene in which nothing moves.
    """
    states = scene.recorded.states
    chosen = sorted(set(np.linspace(0, len(states) - 1, THRESHOLD_STATES).astype(int))) if states else []
    found = [delta_magnitudes(scene, states[k]) for k in chosen]
    limits = {
        kind: otsu_of_magnitudes(torch.cat([magnitudes[kind].cpu() for magnitudes in found])) if found else None
        for kind in DELTAS
    }
    if all(limit is None for limit in limits.values()):
        raise NeecoError(
            f"scene: method {scene.method!r} moves nothing with the state; --labels threshold needs deltas"
        )
    return DeltaThresholds(**limits)


def otsu_of_magnitudes(magnitudes: Tensor) -> float | None:
    """Otsu's threshold of log10 of magnitudes [N] >= 0, in the magnitudes' unit; None when they are all alike."""
    values = magnitudes.double()
    largest = float(values.max()) if len(values) else 0.0
    if largest <= 0 or float(values.min()) > 0.999 * largest:
        return None
    logs = np.log10(np.maximum(values.numpy(), 1e-6 * largest))  # exact zeros form one class at the bottom
    return 10 ** otsu(torch.from_numpy(logs))
