"""Labels that compositing decides: every Gaussian carries the instrument and part it belongs to.

Occlusion by tissue and by other instruments is right by construction. The default, and what evaluation scores.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from neeco.capture.model import State
from neeco.errors import NeecoError
from neeco.raster import rasterize
from neeco.raster.types import Camera, Gaussians, Rendering

if TYPE_CHECKING:
    from neeco.scene import Drawable, Scene

# Measured: the instrument's moving shadow is learned with labels of .3 to .5, so half is too low; .65 to .7 is best.
LABEL_THRESHOLD = 0.65
SHADOWED_THRESHOLD = 0.55  # where that shadow is drawn as one: .65 then loses as much of the rim
# A share below the first is clearly tissue, one above the second clearly instrument. Measured by what a U-Net learns
# beside the band: one from .15 leaves out mostly tissue, so that the model over-segments (IoU .93 instead of .96).
CLEAR_SHARES = 0.5, 0.9


def threshold_of(scene: Drawable) -> float:
    """The share of a pixel from which the scene's labels count it as instrument, unless a user says otherwise."""
    return SHADOWED_THRESHOLD if scene.casts_shadow else LABEL_THRESHOLD


def composited_parts(rendering: Rendering, threshold: float) -> Tensor:
    """uint8 [H, W] part ids of an image drawn with `channels=scene.label_channels()` (see `composited_labels`)."""
    return composited_labels(rendering, threshold)[0]


def composited_labels(rendering: Rendering, threshold: float) -> tuple[Tensor, Tensor]:
    """Part ids (uint8 [H, W]) and share of instrument ([H, W]) of an image drawn with the scene's label channels.

    The share is the sum of a pixel's label columns, instrument where it exceeds `threshold`; its id is the largest
    column's index + 1, 0 is tissue. Occlusion is right because compositing did it. Raises NeecoError when there are no
    such channels.
    """
    channels = rendering.channels
    if channels is None:
        raise NeecoError(
            "labels: the image was drawn without label channels; draw it with channels=scene.label_channels()"
        )
    channels = channels.detach()
    share = channels.sum(dim=-1)
    if channels.shape[-1] == 0:
        return torch.zeros_like(share, dtype=torch.uint8), share
    ids = channels.argmax(dim=-1) + 1
    return torch.where(share > threshold, ids, 0).to(torch.uint8), share


def instruments_of(names: tuple[tuple[str, str], ...]) -> tuple[str, ...]:
    """The instruments of (instrument, part) names, in order of first appearance."""
    return tuple(dict.fromkeys(instrument for instrument, _ in names))


class CompositedLabels:
    """The labeller (see `drawing.Labeller`) that goes by what every Gaussian carries (`scene.label_channels()`)."""

    def __init__(self, scene: Scene, threshold: float | None = None) -> None:
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
        """[N] the instrument that holds most of a Gaussian, -1 when the tissue holds half of it or more."""
        return self._owners

    def draw(
        self, gaussians: Gaussians, camera: Camera, owners: Tensor, unobserved: Tensor | None = None
    ) -> tuple[Rendering, Tensor, Tensor]:
        """One pass: colour and label channels together."""
        channels = self.channels if unobserved is None else torch.cat([self.channels, unobserved[:, None]], 1)
        rendering = rasterize(gaussians, camera, channels=channels)
        assert rendering.channels is not None
        labels = replace(rendering, channels=rendering.channels[..., : len(self.names)])
        return rendering, *composited_labels(labels, self.threshold)
