"""Draw one state as a camera sees it, with the part that every pixel shows.

`draw` is for looking and scoring; `draw_layers` also draws what labels need: the tissue and each instrument alone.
Two labellers say which pixel is which: composited.py and threshold.py. Whatever device draws, a drawing is on the CPU.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Protocol

import numpy as np
import torch
from torch import Tensor

from neeco.capture.model import State
from neeco.labels.composited import composited_parts, instruments_of, threshold_of
from neeco.labels.contours import without_speckle
from neeco.labels.edges import uncertain_edge, without_pieces
from neeco.raster import rasterize
from neeco.raster.types import Camera, Gaussians, Rendering

if TYPE_CHECKING:
    from neeco.scene import Drawable, Scene

MOSTLY = 0.5  # of a pixel
SURFACE_ALPHA = 0.5  # less opaque than this there is no surface to speak of


@dataclass(frozen=True)
class Drawing:
    """A state as the scene draws it."""

    image: Tensor  # [H, W, 3] in [0, 1]
    parts: Tensor | None  # [H, W] uint8, 0 tissue, else index into the label names + 1; None: the scene has no labels


@dataclass(frozen=True)
class Alone:
    """One instrument drawn without the tissue and the other instruments."""

    mask: np.ndarray  # [H, W] bool
    depth: np.ndarray  # [H, W] mm, 0 = none


@dataclass(frozen=True)
class LayeredDrawing(Drawing):
    """A drawing as some labeller sees it, with what stands behind and before it; depths [H, W] in mm, 0 = none."""

    parts: Tensor  # [H, W] uint8, 0 tissue, else index into the labeller's names + 1
    share: Tensor  # [H, W] in [0, 1]: how much of a pixel is instrument, whichever; 0 in pieces that are not labelled
    state: State
    camera: Camera
    depth: np.ndarray
    tissue_depth: np.ndarray  # of the tissue drawn alone
    tissue_image: Tensor | None  # [H, W, 3] in [0, 1], the same, where it was asked for
    alone: dict[str, Alone]  # by instrument
    unobserved: Tensor  # [H, W] in [0, 1]: how much of a pixel no training frame saw, or not from about there

    @property
    def ignored(self) -> Tensor:
        """[H, W] bool: pixels that a trainer had better not count: the edge (see `edges.uncertain_edge`), and what is
        mostly made up."""
        edge = torch.from_numpy(uncertain_edge(self.share.numpy(), self.parts.numpy() > 0))
        return edge | (self.unobserved > MOSTLY)


class Labeller(Protocol):
    """Says which Gaussian is which instrument's, and which pixel is which part."""

    names: tuple[tuple[str, str], ...]  # (instrument, part) of mask id 1, 2, ...

    def owners(self, state: State, posed: Gaussians) -> Tensor:
        """[N] int64: index of each Gaussian's instrument in `instruments_of(names)`, -1 for tissue."""
        ...

    def draw(
        self, gaussians: Gaussians, camera: Camera, owners: Tensor, unobserved: Tensor | None = None
    ) -> tuple[Rendering, Tensor, Tensor]:
        """The whole scene drawn, its part ids [H, W] uint8, and how much of each pixel is instrument [H, W]. Where
        `made_up` [N] is given, the rendering's last channel is that."""
        ...


@torch.no_grad()
def draw(scene: Drawable, state: State, camera: Camera) -> Drawing:
    """Draw `state` as `camera` sees it, with the scene's own labels where it has any."""
    rendering = scene.render(state, camera, labels=True)
    parts = None if rendering.channels is None else composited_parts(rendering, threshold_of(scene)).cpu()
    return Drawing(rendering.color.clamp(0, 1).cpu(), parts)


@torch.no_grad()
def draw_layers(
    scene: Scene, labeller: Labeller, state: State, camera: Camera, speckle: float, tissue_image: bool = False
) -> LayeredDrawing:
    """Draw `state` as `camera` sees it, labelled by `labeller`, and tissue and instruments alone; of these the depth,
    and with `tissue_image` what the tissue looks like.

    Pieces of an instrument smaller than `speckle` of its largest are not labelled.
    """
    gaussians = scene.at(state)
    learned_camera = scene.camera(camera)
    owners = labeller.owners(state, gaussians)
    unobserved = scene.unobserved(gaussians, learned_camera)
    rendering, parts, share = labeller.draw(gaussians, learned_camera, owners, unobserved)
    assert rendering.channels is not None
    parts, share = _without_speckle(parts.cpu(), share.clamp(0, 1).cpu(), labeller.names, speckle)
    bare = replace(gaussians, sh=gaussians.sh[:, :1], headlight=None)  # colour takes time, and depth knows none
    alone = {}
    for k, name in enumerate(instruments_of(labeller.names)):
        if name in state.instruments:
            single = rasterize(bare.select(owners == k), learned_camera)
            alone[name] = Alone((single.alpha > threshold_of(scene)).cpu().numpy(), surface_depth(single))
    behind = owners < 0
    looked_at = gaussians if tissue_image else bare
    tissue = rasterize(looked_at.select(behind), learned_camera)
    return LayeredDrawing(
        image=rendering.color.clamp(0, 1).cpu(),
        parts=parts,
        share=share,
        state=state,
        camera=camera,
        depth=surface_depth(rendering),
        tissue_depth=surface_depth(tissue),
        tissue_image=tissue.color.clamp(0, 1).cpu() if tissue_image else None,
        alone=alone,
        unobserved=rendering.channels[..., -1].cpu(),
    )


def surface_depth(rendering: Rendering) -> np.ndarray:
    """Expected depth [H, W] mm where something opaque was drawn, 0 elsewhere."""
    return to_numpy(torch.where(rendering.alpha > SURFACE_ALPHA, rendering.depth, 0.0))


def to_numpy(tensor: Tensor) -> np.ndarray:
    """A tensor of any device as float64 numbers."""
    return tensor.detach().cpu().double().numpy()


def _without_speckle(
    parts: Tensor, share: Tensor, names: tuple[tuple[str, str], ...], speckle: float
) -> tuple[Tensor, Tensor]:
    cleaned = torch.zeros_like(parts)
    for instrument in instruments_of(names):
        ids = [k + 1 for k, (owner, _) in enumerate(names) if owner == instrument]
        keep = torch.from_numpy(without_speckle(np.isin(parts.numpy(), ids), speckle))
        cleaned[keep] = parts[keep]
    kept = (cleaned > 0).numpy()
    return cleaned, torch.from_numpy(without_pieces(share.numpy(), kept, dropped=(parts > 0).numpy() & ~kept))
