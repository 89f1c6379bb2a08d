"""Draw one state as a camera sees it, with everything that labels need.

Two ways to say which pixel is which:

- `CompositedLabels`: every Gaussian carries the instrument and part it belongs to, and compositing decides; occlusion
  by tissue and by other instruments is right by construction. The default.
- `ThresholdLabels`: the paper's. Gaussians whose deltas exceed thresholds are the instrument; they are drawn alone on
  black, and what is not black is the mask. Knows neither parts nor what stands in front of the instrument.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Protocol

import numpy as np
import torch
from torch import Tensor

from neeco.capture.model import State
from neeco.errors import NeecoError
from neeco.labels.composited import LABEL_THRESHOLD, composited_parts
from neeco.labels.geometry import without_speckle
from neeco.raster import rasterize
from neeco.raster.types import Camera, Gaussians, Rendering

if TYPE_CHECKING:
    from neeco.scene import Scene

BLACK = 0.1  # RGB magnitude (norm) above which a pixel of the instrument drawn alone is the instrument
SURFACE_ALPHA = 0.5  # less opaque than this there is no surface to speak of
HISTOGRAM_BINS = 256
THRESHOLD_STATES = 24  # recorded states that Otsu's method looks at


@dataclass(frozen=True)
class Alone:
    """One instrument drawn without the tissue and the other instruments."""

    mask: np.ndarray  # [H, W] bool
    depth: np.ndarray  # [H, W] mm, 0 = none


@dataclass(frozen=True)
class Drawing:
    """One drawn image and its labels."""

    state: State
    camera: Camera
    image: Tensor  # [H, W, 3] in [0, 1]
    depth: np.ndarray  # [H, W] mm, 0 = none
    parts: np.ndarray  # [H, W] uint8, 0 tissue, else index into the labeller's names + 1
    tissue_depth: np.ndarray  # [H, W] mm, of the tissue drawn alone, 0 = none
    alone: dict[str, Alone]  # by instrument


class Labeller(Protocol):
    """Says which Gaussian is which instrument's, and which pixel is which part."""

    names: tuple[tuple[str, str], ...]  # (instrument, part) of mask id 1, 2, ...

    def owners(self, state: State, posed: Gaussians) -> Tensor:
        """[N] int64: index of each Gaussian's instrument in `instruments_of(names)`, -1 for tissue."""
        ...

    def draw(self, gaussians: Gaussians, camera: Camera, owners: Tensor) -> tuple[Rendering, np.ndarray]:
        """The whole scene drawn, and its part ids [H, W] uint8."""
        ...


def instruments_of(names: tuple[tuple[str, str], ...]) -> tuple[str, ...]:
    """The instruments named, in order of first appearance."""
    return tuple(dict.fromkeys(instrument for instrument, _ in names))


@torch.no_grad()
def draw(scene: Scene, labeller: Labeller, state: State, camera: Camera, speckle: float) -> Drawing:
    """Draw `state` as `camera` sees it: image, depth, part ids, the tissue's depth, and every instrument alone."""
    gaussians = scene.at(state)
    learned_camera = scene.camera(camera)
    owners = labeller.owners(state, gaussians)
    rendering, parts = labeller.draw(gaussians, learned_camera, owners)
    instruments = instruments_of(labeller.names)
    parts = _without_speckle(parts, labeller.names, speckle)
    alone = {}
    for k, name in enumerate(instruments):
        single = rasterize(select(gaussians, owners == k), learned_camera)
        mask = (single.alpha > LABEL_THRESHOLD).cpu().numpy()
        if name in state.instruments:
            alone[name] = Alone(mask, surface_depth(single))
    tissue = rasterize(select(gaussians, owners < 0), learned_camera)
    return Drawing(
        state=state,
        camera=camera,
        image=rendering.color.clamp(0, 1).cpu(),
        depth=surface_depth(rendering),
        parts=parts,
        tissue_depth=surface_depth(tissue),
        alone=alone,
    )


def select(gaussians: Gaussians, chosen: Tensor) -> Gaussians:
    """The chosen Gaussians (bool [N])."""
    light = gaussians.headlight
    return Gaussians(
        means=gaussians.means[chosen],
        quats=gaussians.quats[chosen],
        scales=gaussians.scales[chosen],
        opacities=gaussians.opacities[chosen],
        sh=gaussians.sh[chosen],
        sh_frames=None if gaussians.sh_frames is None else gaussians.sh_frames[chosen],
        headlight=None if light is None else replace(light, falloff=light.falloff[chosen]),
    )


def surface_depth(rendering: Rendering) -> np.ndarray:
    """Expected depth [H, W] mm where something opaque was drawn, 0 elsewhere."""
    return torch.where(rendering.alpha > SURFACE_ALPHA, rendering.depth, 0.0).double().cpu().numpy()


class CompositedLabels:
    """Labels that compositing decides, from what every Gaussian carries (`scene.label_channels()`)."""

    def __init__(self, scene: Scene, threshold: float = LABEL_THRESHOLD) -> None:
        self.names = tuple(scene.label_names)
        if not self.names:
            raise NeecoError(
                f"scene: method {scene.method!r} learns no instrument labels; "
                "use --labels threshold, or train with --method kinematic"
            )
        self.threshold = threshold
        with torch.no_grad():
            self.channels = scene.label_channels()  # [N, L]
        columns = [instruments_of(self.names).index(instrument) for instrument, _ in self.names]
        per_instrument = self.channels.new_zeros(len(self.channels), max(columns) + 1)
        per_instrument.index_add_(1, torch.tensor(columns, device=self.channels.device), self.channels)
        owner = per_instrument.argmax(dim=1)
        self._owners = torch.where(per_instrument.sum(dim=1) > 0.5, owner, -1)

    def owners(self, state: State, posed: Gaussians) -> Tensor:
        """[N] the instrument that holds most of a Gaussian, -1 when the tissue holds half of it or more."""
        return self._owners

    def draw(self, gaussians: Gaussians, camera: Camera, owners: Tensor) -> tuple[Rendering, np.ndarray]:
        """One pass: colour and label channels together."""
        rendering = rasterize(gaussians, camera, channels=self.channels)
        return rendering, np.asarray(composited_parts(rendering, self.threshold), dtype=np.uint8)


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
    """The paper's labels: what moves is the instrument; drawn alone on black, what is not black is its mask.

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

    def draw(self, gaussians: Gaussians, camera: Camera, owners: Tensor) -> tuple[Rendering, np.ndarray]:
        """Colour of the whole scene; ids from the moved Gaussians drawn alone."""
        moved = owners >= 0
        shares = torch.nn.functional.one_hot(owners[moved], len(self.names)).to(gaussians.means)
        alone = rasterize(select(gaussians, moved), camera, channels=shares)
        assert alone.channels is not None
        ids = alone.channels.argmax(dim=2) + 1
        lit = alone.color.norm(dim=2) > self.black
        return rasterize(gaussians, camera), torch.where(lit, ids, 0).to(torch.uint8).cpu().numpy()


@torch.no_grad()
def delta_magnitudes(scene: Scene, state: State) -> dict[str, Tensor]:
    """How far `state` moves each Gaussian from canonical: norms [N] of the deltas of "means", "quats", "scales"."""
    deltas = scene.deltas(state)
    return {kind: getattr(deltas, kind).norm(dim=1) for kind in ("means", "quats", "scales")}


def find_thresholds(scene: Scene) -> DeltaThresholds:
    """Thresholds by Otsu's method on the deltas' log-magnitude over recorded states (the paper leaves them open).

    Raises NeecoError when no kind of delta tells Gaussians apart, as in a scene in which nothing moves.
    """
    states = scene.recorded.states
    chosen = (
        [states[k] for k in np.unique(np.linspace(0, len(states) - 1, THRESHOLD_STATES).astype(int))] if states else []
    )
    pooled: dict[str, list[np.ndarray]] = {"means": [], "quats": [], "scales": []}
    for state in chosen:
        for kind, magnitude in delta_magnitudes(scene, state).items():
            pooled[kind].append(magnitude.double().cpu().numpy())
    limits = {kind: otsu_of_magnitudes(np.concatenate(values)) if values else None for kind, values in pooled.items()}
    if all(limit is None for limit in limits.values()):
        raise NeecoError(
            f"scene: method {scene.method!r} moves nothing with the state; --labels threshold needs deltas"
        )
    return DeltaThresholds(**limits)


def otsu_of_magnitudes(magnitudes: np.ndarray) -> float | None:
    """Otsu's threshold (1979) of log10 of magnitudes >= 0, in the magnitudes' unit; None when they are all alike."""
    largest = float(magnitudes.max(initial=0.0))
    if largest <= 0 or float(magnitudes.min()) > 0.999 * largest:
        return None
    logs = np.log10(np.maximum(magnitudes, 1e-6 * largest))  # exact zeros form one class at the bottom
    counts, edges = np.histogram(logs, bins=HISTOGRAM_BINS)
    centres = (edges[:-1] + edges[1:]) / 2
    below = np.cumsum(counts)[:-1].astype(float)
    above = counts.sum() - below
    sums = np.cumsum(counts * centres)
    mean_below = sums[:-1] / np.maximum(below, 1)
    mean_above = (sums[-1] - sums[:-1]) / np.maximum(above, 1)
    between = below * above * (mean_below - mean_above) ** 2
    # an empty gap between the classes gives a plateau: take its middle
    best = np.flatnonzero(between >= between.max() * (1 - 1e-9))
    return float(10 ** edges[1 + round(float(best.mean()))])


def _without_speckle(parts: np.ndarray, names: tuple[tuple[str, str], ...], share: float) -> np.ndarray:
    cleaned = np.zeros_like(parts)
    for instrument in instruments_of(names):
        ids = [k + 1 for k, (owner, _) in enumerate(names) if owner == instrument]
        keep = without_speckle(np.isin(parts, ids), share)
        cleaned[keep] = parts[keep]
    return cleaned
