"""Which drawn states are worth keeping: the instrument is in the image and not in the tissue."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations, product
from typing import TYPE_CHECKING

import numpy as np
import torch

from neeco.capture.model import State
from neeco.labels.annotation import place_in_image
from neeco.labels.drawing import MOSTLY, Labeller, LayeredDrawing, draw_layers, to_numpy
from neeco.raster.types import Camera

if TYPE_CHECKING:
    from neeco.scene import Scene

WORKING_END = ("hinge", "tip_left", "tip_right")
BURIED_SHARE = 0.05
TOLERANCE_MM = (2.0, 5.0)
TOLERANCE_STATES = 12
APART_MM = 6.0  # surfaces of instruments seen at one place, or their insides meet: about a shaft's thickness
CROSSING = 5  # px nearer than that: instruments are taken to be in each other
MOST_MADE_UP = 0.25  # of an image's pixels
LEAVES_IMAGE, ENTERS_TISSUE, ENTERS_ANOTHER = "leaves the image", "enters the tissue", "enters another"
UNSEEN = "stands before tissue that no frame saw"
UNSEEN_SIDE = "shows sides that no frame saw"


@dataclass(frozen=True)
class Acceptance:
    """When to refuse a drawn state.

    min_share: of the image's pixels that the instruments must cover together. tolerance_mm: how deep an instrument may
    lie behind the tissue surface, as this camera sees it (see `buried_depth`); None asks nothing. A single view cannot
    tell "inside the tissue" from "behind a fold of it": both are refused. max_unseen: share of the instruments' pixels
    that may be mostly made up. casts: instruments that were recorded together, which alone may touch; empty: all were.
    """

    min_share: float
    tolerance_mm: float | None
    max_unseen: float = 1.0
    casts: tuple[frozenset[str], ...] = ()

    def why_refused(self, scene: Scene, drawing: LayeredDrawing) -> str | None:
        """The reason, or None when the drawing is worth keeping."""
        keypoints = working_ends(scene, drawing.state)
        # first: an instrument wholly behind the tissue shows no pixels either
        if self.tolerance_mm is not None and buried_depth(scene, drawing) > self.tolerance_mm:
            return ENTERS_TISSUE
        if int(drawing.parts.count_nonzero()) < self.min_share * drawing.parts.numel():
            return LEAVES_IMAGE
        if keypoints and not any_in_image(drawing.camera, keypoints):
            return LEAVES_IMAGE
        unobserved = drawing.unobserved > MOSTLY
        if float(unobserved.float().mean()) > MOST_MADE_UP:
            return UNSEEN
        if float(unobserved[drawing.parts > 0].float().mean()) > self.max_unseen:
            return UNSEEN_SIDE
        if any(_crossing(drawing, a, b) for a, b in combinations(self.casts, 2)):
            return ENTERS_ANOTHER
        return None


def _crossing(drawing: LayeredDrawing, some: frozenset[str], others: frozenset[str]) -> bool:
    """Whether any of `some` instruments comes so near any of the `others` that they must be in each other, as far as
    this camera sees it."""
    for a, b in product(sorted(some & drawing.alone.keys()), sorted(others & drawing.alone.keys())):
        first, second = drawing.alone[a], drawing.alone[b]
        both = first.mask & second.mask & (first.depth > 0) & (second.depth > 0)
        if int((np.abs(first.depth - second.depth)[both] < APART_MM).sum()) >= CROSSING:
            return True
    return False


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
            if place := place_in_image(point, drawing.camera):
                x, y, z = place
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
    return any_in_image(camera, ends_or_origins(scene, state))


def ends_or_origins(scene: Scene, state: State) -> dict[str, list[np.ndarray]]:
    """The `working_ends`; where none is known, every instrument's origin [3] mm."""
    return working_ends(scene, state) or {
        name: [to_numpy(item.pose[:3, 3])] for name, item in scene.registered(state).instruments.items()
    }


def any_in_image(camera: Camera, points: Mapping[str, Sequence[np.ndarray]]) -> bool:
    """Whether the image shows the place of any of the instruments' points [3] mm of the world."""
    return any(place_in_image(point, camera) is not None for some in points.values() for point in some)
