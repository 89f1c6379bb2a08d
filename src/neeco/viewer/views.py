"""The pictures: what a scene looks like in a state, and what else there is to see of it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from neeco.capture.model import State
from neeco.evaluation.image_metrics import Pixels, difference_map, overlay_parts
from neeco.labels.drawing import surface_depth
from neeco.labels.labellers import composited_parts, threshold_of
from neeco.raster import rasterize
from neeco.raster.types import Camera, Rendering
from neeco.scene.scene import gaussian_scene

if TYPE_CHECKING:
    from neeco.scene import Drawable

IMAGE, OVERLAY, PARTS = "image", "labels over image", "parts"
DEPTH, MADE_UP, DIFFERENCE = "depth", "made up", "difference to the photograph"
VIEWS = (IMAGE, OVERLAY, PARTS, DEPTH, MADE_UP, DIFFERENCE)
LABELLED = (OVERLAY, PARTS)

MADE_UP_COLOR = np.array([255.0, 0.0, 255.0])  # nothing inside a body has it
DEPTH_SHARES = 2, 98  # percentiles that are white and black
DIMMED = 0.35  # of its light is left of what cannot be compared


@dataclass(frozen=True)
class Picture:
    """What is shown, and how far away it is."""

    pixels: Pixels  # uint8 [H, W, 3]
    depth: np.ndarray  # [H, W] mm, 0 = nothing there
    said: str = ""  # what the colours mean, where that differs from picture to picture


def views_of(scene: Drawable, photographs: bool) -> tuple[str, ...]:
    """Which of VIEWS there are of a scene; `photographs`: the capture is at hand."""
    there = {IMAGE, DEPTH}
    if scene.label_names:
        there |= set(LABELLED)
    if scene.has_gaussians:
        there.add(MADE_UP)
    if photographs:
        there.add(DIFFERENCE)
    return tuple(view for view in VIEWS if view in there)


@torch.no_grad()
def picture(scene: Drawable, state: State, camera: Camera, view: str, labels: Tensor | None = None) -> Picture:
    """One of VIEWS but DIFFERENCE of `state` as `camera` sees it. `labels` [N, L]: the scene's label channels, where
    they are at hand; they take time."""
    rendering = _rendering(scene, state, camera, view, labels)
    color, depth = rendering.color.clamp(0, 1).cpu().numpy(), surface_depth(rendering)
    if view in LABELLED:
        parts = composited_parts(rendering, threshold_of(scene)).cpu().numpy()
        if view == PARTS:
            return Picture(overlay_parts(np.zeros_like(color), parts, 1.0), depth)
        return Picture(overlay_parts(color, parts), depth)
    if view == DEPTH:
        return _depth_picture(depth)
    if view == MADE_UP:
        assert rendering.channels is not None
        share = rendering.channels[..., -1:].clamp(0, 1).cpu().numpy()
        said = f"magenta: made up; {share.mean():.1%} of the picture"
        return Picture(_uint8((1 - share) * color * 255 + share * MADE_UP_COLOR), depth, said)
    return Picture(_uint8(color * 255), depth)


@torch.no_grad()
def difference(scene: Drawable, state: State, taken_by: Camera, photograph: np.ndarray, window: Camera) -> Picture:
    """How far what the camera that took `photograph` [H, W, 3] in [0, 1] would see is from it, as `window` shows it: a
    camera at the same place with the same vertical field of view. What it shows beside the photograph is black."""
    rendering = scene.render(state, taken_by)
    compared = difference_map(rendering.color.clamp(0, 1).cpu().numpy(), photograph, legend=False)
    rows, columns = _same_rays(taken_by, window)
    inside = (rows >= 0) & (rows < taken_by.height) & (columns >= 0) & (columns < taken_by.width)
    rows, columns = rows.clip(0, taken_by.height - 1), columns.clip(0, taken_by.width - 1)
    pixels = np.where(inside[..., None], compared[rows, columns], 0).astype(np.uint8)
    return Picture(pixels, np.where(inside, surface_depth(rendering)[rows, columns], 0.0))


def dimmed(shown: Picture) -> Picture:
    """The same picture, darker: it is not what was asked for."""
    return replace(shown, pixels=_uint8(shown.pixels * DIMMED))


def beside(pictures: list[Picture]) -> Picture:
    """Pictures of one height side by side, a white line between them."""
    if len(pictures) == 1:
        return pictures[0]
    pixels = np.concatenate([shown.pixels for shown in pictures], 1)
    for edge in np.cumsum([shown.pixels.shape[1] for shown in pictures])[:-1]:
        pixels[:, edge - 1 : edge + 1] = 255
    said = "; ".join(dict.fromkeys(shown.said for shown in pictures if shown.said))
    return Picture(pixels, np.concatenate([shown.depth for shown in pictures], 1), said)


def split(left: Picture, right: Picture, share: float) -> Picture:
    """One picture left of a white line at `share` of the width, the other right of it; both are of one size."""
    edge = round(share * left.pixels.shape[1])
    pixels = np.concatenate([left.pixels[:, :edge], right.pixels[:, edge:]], 1)
    pixels[:, max(0, edge - 1) : edge + 1] = 255
    depth = np.concatenate([left.depth[:, :edge], right.depth[:, edge:]], 1)
    return Picture(pixels, depth, "; ".join(dict.fromkeys(shown.said for shown in (left, right) if shown.said)))


def _rendering(scene: Drawable, state: State, camera: Camera, view: str, labels: Tensor | None) -> Rendering:
    if view in LABELLED and labels is None:
        return scene.render(state, camera, labels=True)
    if view not in (*LABELLED, MADE_UP):
        return scene.render(state, camera)
    posing = gaussian_scene(scene, f"view: {view}")
    gaussians, camera = posing.at(state), posing.camera(camera)
    channels = labels if view in LABELLED else posing.made_up(gaussians, camera)[:, None]
    return rasterize(gaussians, camera, channels=channels)


def _depth_picture(depth: np.ndarray) -> Picture:
    there = depth > 0
    if not there.any():
        return Picture(np.zeros((*depth.shape, 3), np.uint8), depth, "nothing in view")
    near, far = np.percentile(depth[there], DEPTH_SHARES)
    grey = np.clip((far - depth) / max(far - near, 1e-6), 0, 1) * there
    return Picture(
        _uint8(np.repeat(grey[..., None], 3, 2) * 255), depth, f"white {near:.1f} mm or nearer, black {far:.1f} mm"
    )


def _same_rays(taken_by: Camera, window: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Row and column [H, W] of `taken_by`'s pixel that looks where each of `window`'s pixels does."""
    rows, columns = np.mgrid[0 : window.height, 0 : window.width] + 0.5
    down, right = (rows - window.cy) / window.fy, (columns - window.cx) / window.fx
    return (
        np.floor(down * taken_by.fy + taken_by.cy).astype(int),
        np.floor(right * taken_by.fx + taken_by.cx).astype(int),
    )


def _uint8(pixels: np.ndarray) -> Pixels:
    return np.clip(np.rint(pixels), 0, 255).astype(np.uint8)
