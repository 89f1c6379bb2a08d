"""Which drawn states are worth keeping: the instrument is in the image and not in the tissue."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch

from neeco.capture.model import State
from neeco.labels.annotation import project
from neeco.labels.drawing import Labeller, LayeredDrawing, draw_layers, to_numpy
from neeco.raster.types import Camera

if TYPE_CHECKING:
    from neeco.scene import Scene

WORKING_END = ("hinge", "tip_left", "tip_right")
BURIED_SHARE = 0.05
TOLERANCE_MM = (2.0, 5.0)
TOLERANCE_STATES = 12
LEAVES_IMAGE, ENTERS_TISSUE = "leaves the image", "enters the tissue"


@dataclass(frozen=True)
class Acceptance:
    """When to refuse a drawn state.

    min_share: of the image's pixels that the instruments must cover together. tolerance_mm: how deep an instrument may
    lie behind the tissue surface, as this camera sees it (see `buried_depth`); None asks nothing. A single view cannot
    tell "inside the tissue" from "behind a fold of it": both are refused.
    """

    min_share: float
    tolerance_mm: float | None

    def why_refused(self, scene: Scene, drawing: LayeredDrawing) -> str | None:
        """The reason, or None when the drawing is worth keeping."""
        keypoints = working_ends(scene, drawing.state)
        # first: an instrument wholly behind the tissue shows no pixels either
        if self.tolerance_mm is not None and buried_depth(scene, drawing) > self.tolerance_mm:
            return ENTERS_TISSUE
        if int(drawing.parts.count_nonzero()) < self.min_share * drawing.parts.numel():
            return LEAVES_IMAGE
        if keypoints and not any(in_image(point, drawing.camera) for points in keypoints.values() for point in points):
            return LEAVES_IMAGE
        return None


def buried_depth(scene: Scene, drawing: LayeredDrawing) -> float:
    """How far, in mm, the worst instrument lies behind the tissue surface that this camera sees; 0 for none.

    Of an instrument's pixels all but the deepest BURIED_SHARE are above this depth (edges are uncertain), of the
    keypoints of its working end all are.
    """
    deepest = 0.0
    keypoints = working_ends(scene, drawing.state)
    surface = drawing.tissue_depth
    for name, alone in drawing.alone.items():
        pixels = alone.mask & (alone.depth > 0)
        below = np.where(surface > 0, alone.depth - surface, 0.0)[pixels]
        if len(below):
            deepest = max(deepest, float(np.quantile(below, 1 - BURIED_SHARE)))
        for point in keypoints.get(name, []):
            if in_image(point, drawing.camera):
                x, y, z = project(point, drawing.camera)
                under = float(surface[int(y), int(x)])
                deepest = max(deepest, z - under if under > 0 else 0.0)
    return deepest


def find_tolerance(scene: Scene, labeller: Labeller) -> float:
    """The tolerance, in mm, under which nine of ten recorded states are acceptable, between 2 and 5 mm.

    What was recorded did not enter the tissue; where the model says it did, the model is that inexact. More than
    5 mm is not inexactness: there, tissue stood before the instrument.
    """
    recorded = scene.recorded
    chosen = np.unique(np.linspace(0, len(recorded.states) - 1, TOLERANCE_STATES).astype(int))
    depths = [
        buried_depth(scene, draw_layers(scene, labeller, recorded.states[k], recorded.cameras[k], speckle=0.0))
        for k in chosen
    ]
    return float(np.ceil(100 * np.clip(np.quantile(depths, 0.9), *TOLERANCE_MM)) / 100)


@torch.no_grad()
def working_ends(scene: Scene, state: State) -> dict[str, list[np.ndarray]]:
    """Hinge and jaw tips [3] mm of every instrument for which the scene knows any."""
    ends = {
        instrument: [to_numpy(points[name]) for name in WORKING_END if name in points]
        for instrument, points in scene.keypoints(state).items()
    }
    return {instrument: points for instrument, points in ends.items() if points}


def shows_working_end(scene: Scene, state: State, camera: Camera) -> bool:
    """Whether any hinge or tip projects into the image; where none is known, any instrument's origin."""
    ends = [point for points in working_ends(scene, state).values() for point in points]
    if not ends:
        ends = [to_numpy(instrument.pose[:3, 3]) for instrument in scene.registered(state).instruments.values()]
    return any(in_image(point, camera) for point in ends)


def in_image(point: np.ndarray, camera: Camera) -> bool:
    """Whether a world point [3] mm projects into the image."""
    x, y, z = project(point, camera)
    return z > camera.near and 0 <= x < camera.width and 0 <= y < camera.height
