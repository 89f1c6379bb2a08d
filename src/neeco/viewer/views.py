"""The views of a scene in a state (image, labels, depth, ...), and a run's picture in a browser's window."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from neeco.capture.model import State
from neeco.evaluation.image_metrics import Pixels, difference_map, overlay_parts, to_uint8
from neeco.geometry.camera import Camera
from neeco.labels.drawing import surface_depth
from neeco.labels.labellers import composited_labels, threshold_of
from neeco.raster import rasterize
from neeco.raster.devices import readable_failures
from neeco.raster.types import Rendering
from neeco.scene import DrawableScene
from neeco.scene.gaussian_scene import is_gaussian
from neeco.viewer.controls import Controls, controlled_state
from neeco.viewer.runs import LoadedRun
from neeco.viewer.viser_scene import stands_at

IMAGE, OVERLAY, PARTS = "image", "labels over image", "parts"
DEPTH, UNOBSERVED, DIFFERENCE = "depth", "unobserved", "difference to the recorded image"
VIEWS = (IMAGE, OVERLAY, PARTS, DEPTH, UNOBSERVED, DIFFERENCE)
LABELLED = (OVERLAY, PARTS)
ONLY_RECORDED = "difference: only of a recorded state from its camera; press “go to this frame's camera”"

UNOBSERVED_COLOR = np.array([255.0, 0.0, 255.0])  # nothing inside a body has it
DEPTH_PERCENTILES = 2, 98  # percentiles of the depth that are white and black
DIMMED = 0.35  # share of the light left to what cannot be compared


@dataclass(frozen=True)
class Picture:
    """Shown pixels and their depth."""

    pixels: Pixels  # uint8 [H, W, 3]
    depth: np.ndarray  # [H, W] mm, 0 = nothing there
    note: str = ""  # what the colours mean, where that differs from picture to picture


def views_of(scene: DrawableScene, has_images: bool) -> tuple[str, ...]:
    """The VIEWS that a scene has; has_images: the capture is at hand."""
    absent = set[str]() if scene.label_names else set(LABELLED)
    if not scene.has_gaussians:
        absent.add(UNOBSERVED)
    if not has_images:
        absent.add(DIFFERENCE)
    return tuple(view for view in VIEWS if view not in absent)


@torch.no_grad()
def picture(scene: DrawableScene, state: State, camera: Camera, view: str, labels: Tensor | None = None) -> Picture:
    """One of VIEWS but DIFFERENCE of `state` as `camera` sees it. labels [N, L]: the scene's label channels, where
    they are at hand; they take time."""
    rendering = _rendering(scene, state, camera, view, labels)
    color, depth = rendering.color.clamp(0, 1).cpu().numpy(), surface_depth(rendering)
    if view in LABELLED:
        parts = composited_labels(rendering, threshold_of(scene))[0].cpu().numpy()
        if view == PARTS:
            return Picture(overlay_parts(np.zeros_like(color), parts, 1.0), depth)
        return Picture(overlay_parts(color, parts), depth)
    if view == DEPTH:
        if not (has_depth := depth > 0).any():
            return Picture(np.zeros_like(color, np.uint8), depth, "nothing in view")
        near, far = np.percentile(depth[has_depth], DEPTH_PERCENTILES)
        grey = np.clip((far - depth) / max(far - near, 1e-6), 0, 1) * has_depth
        note = f"white {near:.1f} mm or nearer, black {far:.1f} mm"
        return Picture(to_uint8(np.repeat(grey[..., None], 3, 2) * 255), depth, note)
    if view == UNOBSERVED:
        assert rendering.channels is not None
        share = rendering.channels[..., -1:].clamp(0, 1).cpu().numpy()
        note = f"magenta: unobserved; {share.mean():.1%} of the picture"
        return Picture(to_uint8((1 - share) * color * 255 + share * UNOBSERVED_COLOR), depth, note)
    return Picture(to_uint8(color * 255), depth)


@torch.no_grad()
def difference(scene: DrawableScene, state: State, recorded_by: Camera, image: np.ndarray, window: Camera) -> Picture:
    """Difference between `image` [H, W, 3] in [0, 1] and a rendering by the camera that recorded it, as `window` shows
    it: a camera at the same place with the same vertical field of view. Outside the image it is black."""
    rendering = scene.render(state, recorded_by)
    compared = difference_map(rendering.color.clamp(0, 1).cpu().numpy(), image, legend=False)
    # the recorded pixel [H, W] that looks where each of the window's pixels does
    rows, columns = np.mgrid[0 : window.height, 0 : window.width] + 0.5
    down, right = (rows - window.cy) / window.fy, (columns - window.cx) / window.fx
    rows = np.floor(down * recorded_by.fy + recorded_by.cy).astype(int)
    columns = np.floor(right * recorded_by.fx + recorded_by.cx).astype(int)
    inside = (rows >= 0) & (rows < recorded_by.height) & (columns >= 0) & (columns < recorded_by.width)
    rows, columns = rows.clip(0, recorded_by.height - 1), columns.clip(0, recorded_by.width - 1)
    pixels = np.where(inside[..., None], compared[rows, columns], 0).astype(np.uint8)
    return Picture(pixels, np.where(inside, surface_depth(rendering)[rows, columns], 0.0))


def render_run(loaded: LoadedRun, controls: Controls, camera: Camera, view: str) -> tuple[Picture, bool]:
    """Render a run from `camera`, at the controls; return the picture, and whether state and camera are those of a
    recorded frame. Raises NeecoError."""
    scene, state = loaded.scene, controlled_state(loaded.recorded.states, loaded.shafts, controls)
    frame = controls.recorded_frame
    as_recorded = frame is not None and stands_at(camera, loaded.recorded.cameras[frame], loaded.distance)
    with scene.torch_threads(), readable_failures():
        if view == DIFFERENCE and frame is not None and as_recorded and loaded.frames:
            image = loaded.frames[frame].load_image().numpy()
            return difference(scene, state, loaded.recorded.cameras[frame], image, camera), True
        if view in views_of(scene, False):
            return picture(scene, state, camera, view, loaded.labels), as_recorded
        plain = picture(scene, state, camera, IMAGE)  # darkened, since it is not what was asked for
    note = ONLY_RECORDED if view == DIFFERENCE else f"{view}: a scene of method {scene.method} has none"
    return Picture(to_uint8(plain.pixels * DIMMED), plain.depth, note), as_recorded


def _rendering(scene: DrawableScene, state: State, camera: Camera, view: str, labels: Tensor | None) -> Rendering:
    learned = scene.recorded.as_learned(camera)
    if learned.learned_fx is not None and camera.fx > learned.learned_fx:  # averaging smaller ones would take too long
        camera = learned
    if view in LABELLED and labels is None:
        return scene.render(state, camera, labels=True)
    if view not in (*LABELLED, UNOBSERVED) or not is_gaussian(scene):
        return scene.render(state, camera)
    gaussians = scene.at(state)
    channels = labels if view in LABELLED else scene.unobserved(gaussians, camera)[:, None]
    return rasterize(gaussians, camera, channels=channels)
