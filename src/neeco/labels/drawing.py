"""Renderings of one state with their labels, on the CPU, on whatever device they are rendered.

`draw` is for viewing and scoring; `draw_layers` also renders tissue and instruments alone, for labels.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from torch import Tensor

from neeco.capture.model import State
from neeco.geometry.camera import Camera
from neeco.labels.labellers import Labeller, composited_labels, instruments_of, threshold_of
from neeco.labels.settings import LABELS
from neeco.raster import rasterize
from neeco.raster.types import Gaussians, Layer, Rendering
from neeco.scene import DrawableScene, GaussianScene

NEIGHBOURS = np.ones((3, 3), np.uint8)  # 8-neighbourhood: with 4, the band of a slanted border is thinner than a pixel


@dataclass(frozen=True)
class Drawing:
    """A rendered state."""

    image: Tensor  # [H, W, 3] in [0, 1]
    parts: Tensor | None  # [H, W] uint8, 0 tissue, else index into the label names + 1; None: the scene has no labels


@dataclass(frozen=True)
class InstrumentLayer:
    """One instrument rendered without the tissue and the other instruments."""

    mask: np.ndarray  # [H, W] bool
    depth: np.ndarray  # [H, W] mm, 0 = none


@dataclass(frozen=True, kw_only=True)
class LayeredDrawing(Drawing):
    """A labelled drawing with its layers; depths [H, W] in mm, 0 = none."""

    parts: Tensor  # [H, W] uint8, 0 tissue, else index into the labeller's names + 1
    share: Tensor  # [H, W] in [0, 1]: share of a pixel that is instrument; 0 in components that are not labelled
    state: State
    posed: Gaussians
    camera: Camera
    depth: np.ndarray
    tissue_depth: np.ndarray  # of the tissue alone
    tissue_image: Tensor | None  # [H, W, 3] in [0, 1] of the tissue alone, if requested
    layers: dict[str, InstrumentLayer]  # by instrument
    unobserved: Tensor  # [H, W] in [0, 1]: share of a pixel that no training frame observed from a similar direction
    keypoints: dict[str, dict[str, np.ndarray]]  # by instrument and name, [3] mm, world

    @property
    def ignored(self) -> Tensor:
        """Return bool [H, W]: pixels that a loss should ignore, at `uncertain_edge` of instruments or unobserved."""
        edge = torch.from_numpy(uncertain_edge(self.share.numpy(), self.parts.numpy() > 0))
        return edge | (self.unobserved > LABELS.max_unobserved)


@torch.no_grad()
def draw(scene: DrawableScene, state: State, camera: Camera) -> Drawing:
    """Render `state` for a `camera` of any size and lens, with the scene's own labels where it has any."""
    rendering = scene.render(state, scene.recorded.as_learned(camera), labels=True)
    parts = None if rendering.channels is None else composited_labels(rendering, threshold_of(scene))[0].cpu()
    return Drawing(rendering.color.clamp(0, 1).cpu(), parts)


@torch.no_grad()
def draw_layers(
    scene: GaussianScene,
    labeller: Labeller,
    state: State,
    camera: Camera,
    min_component: float,
    tissue_image: bool = False,
) -> LayeredDrawing:
    """Render `state` for a `camera` of any size and lens, labelled by `labeller`; tissue and instruments also alone.

    Components of an instrument's mask smaller than `min_component` of its largest are not labelled. tissue_image: also
    keep the image of the tissue.
    """
    camera = scene.recorded.as_learned(camera)
    gaussians = scene.at(state)
    owners = labeller.owners(state, gaussians)
    unobserved = scene.unobserved(gaussians, camera)
    instruments = {k: name for k, name in enumerate(instruments_of(labeller.names)) if name in state.instruments}
    alone = [owners == k for k in instruments] + [owners < 0]
    rendering, parts, share = labeller.draw(gaussians, camera, owners, unobserved, alone)
    assert rendering.channels is not None
    original = parts.cpu().numpy()
    cleaned = np.zeros_like(original)
    for instrument in instruments_of(labeller.names):
        ids = [k + 1 for k, (owner, _) in enumerate(labeller.names) if owner == instrument]
        mask = shows_any(original, ids)
        x, y, width, height = cv2.boundingRect(mask.view(np.uint8))
        if width:
            box = slice(y, y + height), slice(x, x + width)
            large_parts = np.where(without_small_components(mask[box], min_component), original[box], 0)
            large_parts = without_part_islands(large_parts, ids, min_component)
            np.copyto(cleaned[box], large_parts, where=large_parts > 0)
    remaining = cleaned > 0
    shares = without_components(share.clamp(0, 1).cpu().numpy(), remaining, (original > 0) & ~remaining)
    threshold = threshold_of(scene)
    layers = {
        name: InstrumentLayer((single.alpha > threshold).cpu().numpy(), surface_depth(single))
        for name, single in zip(instruments.values(), rendering.alone, strict=False)
    }
    tissue = rasterize(gaussians.select(owners < 0), camera).color.clamp(0, 1).cpu() if tissue_image else None
    return LayeredDrawing(
        image=rendering.color.clamp(0, 1).cpu(),
        parts=torch.from_numpy(cleaned),
        share=torch.from_numpy(shares),
        state=state,
        posed=gaussians,
        camera=camera,
        depth=surface_depth(rendering),
        tissue_depth=surface_depth(rendering.alone[-1]),
        tissue_image=tissue,
        layers=layers,
        unobserved=rendering.channels[..., -1].cpu(),
        keypoints=keypoint_arrays(scene, state),
    )


@torch.no_grad()
def extended_silhouettes(
    scene: GaussianScene, labeller: Labeller, state: State, camera: Camera
) -> dict[str, np.ndarray]:
    """Return the silhouette (bool [3 H, 3 W]) of every instrument alone, by name, in the image of a pinhole `camera`
    and beyond its border: the image is the middle ninth."""
    width, height = camera.width, camera.height
    wide = replace(camera, cx=camera.cx + width, cy=camera.cy + height, width=3 * width, height=3 * height)
    wide = scene.recorded.as_learned(wide)
    gaussians = scene.at(state)
    owners = labeller.owners(state, gaussians)
    colorless = replace(gaussians, sh=gaussians.sh[:, :1], headlight=None)
    return {
        name: (rasterize(colorless.select(owners == k), wide).alpha > threshold_of(scene)).cpu().numpy()
        for k, name in enumerate(instruments_of(labeller.names))
        if name in state.instruments
    }


def surface_depth(rendering: Rendering | Layer) -> np.ndarray:
    """Return the expected depth [H, W] mm where the rendering is opaque, 0 elsewhere."""
    return to_numpy(rendering.depth * (rendering.alpha > LABELS.surface_alpha))


@torch.no_grad()
def keypoint_arrays(scene: GaussianScene, state: State) -> dict[str, dict[str, np.ndarray]]:
    """Return the keypoints [3] mm, world frame, by instrument and name."""
    return {
        instrument: {name: to_numpy(point) for name, point in points.items()}
        for instrument, points in scene.keypoints(state).items()
    }


def to_numpy(tensor: Tensor) -> np.ndarray:
    """Return a tensor of any device as a float64 array."""
    return tensor.detach().cpu().double().numpy()


def uncertain_edge(share: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Return bool [H, W]: pixels at the edge of a mask (bool [H, W]) whose label is uncertain.

    These are adjacent to the border, which may be a pixel off even where the share of instrument ([H, W] in [0, 1]) is
    discontinuous, or are within `edge_width` of it with a share between `clear_shares`. The image border is not an
    edge.
    """
    edge = np.zeros(mask.shape, dtype=bool)
    reach = float(LABELS.edge_width * np.hypot(*mask.shape))
    x, y, width, height = cv2.boundingRect(mask.view(np.uint8))
    margin = math.ceil(reach) + 1  # the border is up to a pixel outside
    near = slice(max(0, y - margin), y + height + margin), slice(max(0, x - margin), x + width + margin)
    pixels = mask[near].astype(np.uint8)
    border = cv2.dilate(pixels, NEIGHBOURS) != cv2.erode(pixels, NEIGHBOURS) if width else pixels.astype(bool)
    if border.any():
        unclear = (share[near] > LABELS.clear_shares[0]) & (share[near] < LABELS.clear_shares[1])
        edge[near] = border | (unclear & (distances_to(border) <= reach))
    return edge


def without_small_components(mask: np.ndarray, share: float) -> np.ndarray:
    """Return the mask without the (edge-connected) components smaller than `share` of its largest."""
    count, components, statistics, _ = cv2.connectedComponentsWithStats(mask.view(np.uint8), connectivity=4)
    if count < 3:  # label 0 is the background
        return mask
    areas = statistics[:, cv2.CC_STAT_AREA]
    keep = areas >= share * areas[1:].max()
    keep[0] = False
    return keep[components]


def without_part_islands(parts: np.ndarray, ids: Sequence[int], share: float) -> np.ndarray:
    """Return part ids (uint8 [H, W]) in which small islands of an instrument's parts (`ids`) take the part around them.

    An island is an edge-connected component of a part smaller than `share` of the instrument's pixels that is not the
    part's largest. It takes the part that most pixels touching it have; one that touches no other part stays.
    """
    smallest = share * shows_any(parts, ids).sum()
    cleaned = parts.copy()
    for part in ids:
        mask = (parts == part).view(np.uint8)
        x, y, width, height = cv2.boundingRect(mask)
        if not width:
            continue
        box = slice(max(0, y - 1), y + height + 1), slice(max(0, x - 1), x + width + 1)
        _, components, statistics, _ = cv2.connectedComponentsWithStats(mask[box], connectivity=4)
        areas = statistics[1:, cv2.CC_STAT_AREA]
        small = areas < smallest
        if small.any():
            small[areas.argmax()] = False
        for k in np.flatnonzero(small) + 1:
            x, y, width, height = statistics[k, : cv2.CC_STAT_AREA]
            around = slice(max(0, y - 1), y + height + 1), slice(max(0, x - 1), x + width + 1)
            island = components[around] == k
            surrounded = cleaned[box][around]
            nearby = surrounded[cv2.dilate(island.astype(np.uint8), NEIGHBOURS).astype(bool) & ~island]
            nearby = nearby[np.isin(nearby, ids)]
            if len(nearby):
                surrounded[island] = np.bincount(nearby).argmax()
    return cleaned


def without_components(share: np.ndarray, remaining: np.ndarray, dropped: np.ndarray) -> np.ndarray:
    """Return the share of instrument [H, W] with 0 in a mask's dropped components and their faint surroundings.

    remaining, dropped: bool [H, W], together the mask. A pixel of neither that is not clearly instrument belongs to the
    nearest component.
    """
    if not dropped.any():
        return share
    fading = ~remaining & (share < LABELS.clear_shares[1]) & (distances_to(dropped) < distances_to(remaining))
    return np.where(dropped | fading, np.float32(0), share)


def shows_any(parts: np.ndarray, ids: Sequence[int]) -> np.ndarray:
    """Return bool [H, W]: pixels of a part image (uint8 [H, W]) with one of these ids."""
    chosen = np.zeros(256, dtype=np.uint8)
    chosen[list(ids)] = 1
    return cv2.LUT(parts, chosen).view(bool)


def distances_to(pixels: np.ndarray) -> np.ndarray:
    """Return distances [H, W] px, between centres, to the nearest of the pixels (bool [H, W]), huge without any; exact
    (Felzenszwalb and Huttenlocher, "Distance transforms of sampled functions", 2012)."""
    return cv2.distanceTransform((~pixels).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
