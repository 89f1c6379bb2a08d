"""Labels of pixels: instrument and part.

`CompositedLabels` (the default, which evaluation scores): every Gaussian carries its instrument and part, and
compositing handles occlusion by tissue and other instruments. `ThresholdLabels` (the paper's): whatever moves is the
instrument, without parts and occlusion.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from neeco.base.errors import NeecoError
from neeco.capture.model import State, evenly_spaced
from neeco.geometry.camera import Camera
from neeco.labels.settings import LABELS
from neeco.raster import rasterize
from neeco.raster.types import Gaussians, Rendering
from neeco.scene import DrawableScene, GaussianScene
from neeco.scene.deformation import otsu

DELTAS = ("means", "quats", "scales")
# by DELTAS, magnitude above which a Gaussian counts as moved: position (mm), rotation (quaternion), scale (mm); None:
# this kind of delta is the same for all Gaussians
Thresholds = dict[str, float | None]


def threshold_of(scene: DrawableScene) -> float:
    """Return the share of a pixel above which it is labelled instrument in a scene."""
    return LABELS.shadowed_threshold if scene.casts_shadow else LABELS.threshold


def instruments_of(names: tuple[tuple[str, str], ...]) -> tuple[str, ...]:
    """Return the instruments of (instrument, part) names, in order of first appearance."""
    return tuple(dict.fromkeys(instrument for instrument, _ in names))


def composited_labels(rendering: Rendering, threshold: float) -> tuple[Tensor, Tensor]:
    """Return part ids (uint8 [H, W]) and share of instrument ([H, W]) of an image rendered with label channels.

    The share is the sum of a pixel's label columns. Where it exceeds `threshold`, the id is the index of the largest
    column + 1, elsewhere 0 (tissue). Raises NeecoError when there are no such channels.
    """
    channels = rendering.channels
    if channels is None:
        raise NeecoError(
            "labels: the image was rendered without label channels; render it with channels=scene.label_channels()"
        )
    channels = channels.detach()
    # for the few values per pixel, PyTorch is four times faster on columns; up to 4, its order of summation is the same
    few = 0 < channels.shape[-1] <= 4
    share = sum(channels.unbind(-1)[1:], start=channels[..., 0].clone()) if few else channels.sum(dim=-1)
    parts = torch.zeros(share.shape, dtype=torch.uint8, device=share.device)
    if channels.shape[-1] > 0:
        chosen = (share > threshold).flatten().nonzero()[:, 0]  # only foreground pixels, as argmax is slow
        parts.view(-1)[chosen] = (channels.flatten(0, 1)[chosen].argmax(dim=-1) + 1).to(torch.uint8)
    return parts, share


class CompositedLabels:
    """Labels from the Gaussians' own label weights (`scene.label_channels()`).

    names: (instrument, part) of part id 1, 2, ...
    """

    def __init__(self, scene: GaussianScene, threshold: float | None = None) -> None:
        self.names = tuple(scene.label_names)
        if not self.names:
            raise NeecoError(
                f"scene: method {scene.method!r} learns no instrument labels; "
                "use --labels threshold, or train with --method kinematic"
            )
        self.threshold = threshold_of(scene) if threshold is None else threshold
        with torch.no_grad():
            self.channels = scene.label_channels()  # [N, L]
        columns = [instruments_of(self.names).index(instrument) for instrument, _ in self.names]
        per_instrument = self.channels.new_zeros(len(self.channels), max(columns) + 1)
        per_instrument.index_add_(1, torch.tensor(columns, device=self.channels.device), self.channels)
        owner = per_instrument.argmax(dim=1)
        self._owners = torch.where(per_instrument.sum(dim=1) > 0.5, owner, -1)

    def owners(self, state: State, posed: Gaussians) -> Tensor:
        """Return [N] int64: index in `instruments_of(names)` of the instrument that holds most of a Gaussian, -1 where
        the tissue holds half of it or more."""
        return self._owners

    def draw(
        self,
        gaussians: Gaussians,
        camera: Camera,
        owners: Tensor,
        unobserved: Tensor | None = None,
        alone: Sequence[Tensor] = (),
    ) -> tuple[Rendering, Tensor, Tensor]:
        """Render the whole scene in one pass; return it, part ids [H, W] uint8 and shares of instrument [H, W].

        unobserved [N]: becomes the rendering's last channel. alone: as `rasterize` takes it.
        """
        channels = self.channels if unobserved is None else torch.cat([self.channels, unobserved[:, None]], 1)
        rendering = rasterize(gaussians, camera, channels=channels, alone=alone)
        assert rendering.channels is not None
        labels = replace(rendering, channels=rendering.channels[..., : len(self.names)])
        return rendering, *composited_labels(labels, self.threshold)


class ThresholdLabels:
    """The paper's labels: Gaussians whose deltas exceed thresholds are rendered alone on black, and all other than
    black pixels are the mask. The paper has one instrument; of several, the nearest owns a moved Gaussian."""

    def __init__(self, scene: GaussianScene, thresholds: Thresholds | None = None) -> None:
        instruments = tuple(instrument.name for instrument in scene.instruments)
        if not instruments:
            raise NeecoError("scene: --labels threshold needs a scene with instruments; this one was trained without")
        self.names = tuple((name, "instrument") for name in instruments)
        self.scene = scene
        self.thresholds = thresholds or find_thresholds(scene)

    def owners(self, state: State, posed: Gaussians) -> Tensor:
        """Return [N] int64: index in `names` of the instrument nearest to a Gaussian that moved, -1 for others."""
        magnitudes = delta_magnitudes(self.scene, state)
        tests = [magnitudes[kind] > limit for kind, limit in self.thresholds.items() if limit is not None]
        moved = torch.stack(tests).all(dim=0)  # which Gaussians exceed all thresholds that are set
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
        self,
        gaussians: Gaussians,
        camera: Camera,
        owners: Tensor,
        unobserved: Tensor | None = None,
        alone: Sequence[Tensor] = (),
    ) -> tuple[Rendering, Tensor, Tensor]:
        """Render like `CompositedLabels`; ids and share (the alpha) are from the moved Gaussians alone."""
        moved = owners >= 0
        shares = torch.nn.functional.one_hot(owners[moved], len(self.names)).to(gaussians.means)
        instruments = rasterize(gaussians.select(moved), camera, channels=shares)
        assert instruments.channels is not None
        ids = instruments.channels.argmax(dim=2) + 1
        lit = instruments.color.norm(dim=2) > LABELS.min_brightness
        channels = None if unobserved is None else unobserved[:, None]
        rendering = rasterize(gaussians, camera, channels=channels, alone=alone)
        return rendering, torch.where(lit, ids, 0).to(torch.uint8), instruments.alpha


Labeller = CompositedLabels | ThresholdLabels


@torch.no_grad()
def delta_magnitudes(scene: GaussianScene, state: State) -> dict[str, Tensor]:
    """Return norms [N] of the deltas from canonical to `state`, of "means", "quats" and "scales"."""
    deltas = scene.deltas(state)
    return {kind: getattr(deltas, kind).norm(dim=1) for kind in DELTAS}


def find_thresholds(scene: GaussianScene) -> Thresholds:
    """Return thresholds by Otsu's method on the deltas' log-magnitude over recorded states (open in the paper).

    Raises NeecoError when no kind of delta separates Gaussians, as in a scene in which nothing moves.
    """
    states = scene.recorded.states
    chosen = evenly_spaced(len(states), LABELS.n_threshold_states, floor=True)
    deltas = [delta_magnitudes(scene, states[k]) for k in chosen]
    limits = {
        kind: otsu_of_magnitudes(torch.cat([magnitudes[kind].cpu() for magnitudes in deltas])) if deltas else None
        for kind in DELTAS
    }
    if all(limit is None for limit in limits.values()):
        raise NeecoError(
            f"scene: method {scene.method!r} moves nothing with the state; --labels threshold needs deltas"
        )
    return limits


def otsu_of_magnitudes(magnitudes: Tensor) -> float | None:
    """Return Otsu's threshold of log10 of magnitudes [N] >= 0, in the magnitudes' unit; None when all are similar."""
    values = magnitudes.double()
    largest = float(values.max()) if len(values) else 0.0
    if largest <= 0 or float(values.min()) > 0.999 * largest:
        return None
    logs = np.log10(np.maximum(values.numpy(), 1e-6 * largest))  # exact zeros form one class at the bottom
    return 10 ** otsu(torch.from_numpy(logs))
