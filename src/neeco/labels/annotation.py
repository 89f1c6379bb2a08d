"""What a drawing says about each instrument: boxes, polygons, parts, visibility, keypoints, pose."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from neeco.labels.composited import instruments_of
from neeco.labels.contours import bounding_box, minimum_rectangle, outer_polygons
from neeco.labels.drawing import LayeredDrawing, to_numpy
from neeco.raster.geometry import project
from neeco.raster.types import Camera

if TYPE_CHECKING:
    from neeco.scene import Scene

KEYPOINTS = ("shaft_far", "shaft_near", "hinge", "tip_left", "tip_right")
SKELETON = (("shaft_far", "shaft_near"), ("shaft_near", "hinge"), ("hinge", "tip_left"), ("hinge", "tip_right"))
OUTSIDE, OCCLUDED, VISIBLE = 0, 1, 2  # OUTSIDE: of the image, or the scene has nothing of the instrument
OTHERS_MM = 1.0  # a surface of something else this much nearer than a keypoint hides it
SELF_MM = 6.0  # keypoints lie inside their instrument: its own surface hides them only from this much nearer


@dataclass(frozen=True)
class Shape:
    """A mask in numbers. Pixel edges: pixel (x, y) covers [x, x + 1] x [y, y + 1]."""

    area: int  # px
    box: tuple[int, int, int, int]  # x, y, width, height, of the extreme pixels
    rectangle: list[list[float]]  # 4 corners of the minimum-area rectangle
    polygons: list[list[list[float]]]  # outer contours, largest first


@dataclass(frozen=True)
class Keypoint:
    """A projected keypoint."""

    x: float
    y: float
    visibility: int  # OUTSIDE, OCCLUDED or VISIBLE


@dataclass(frozen=True)
class InstrumentLabel:
    """Everything known of one instrument in one image."""

    name: str
    shape: Shape | None  # None: no pixel of it is seen
    visibility: float  # pixels seen / pixels if nothing else were there
    parts: dict[str, Shape]  # parts seen
    keypoints: dict[str, Keypoint]
    camera_from_instrument: list[list[float]]  # 4x4 rigid, mm, OpenCV camera axes

    def to_json(self) -> dict[str, Any]:
        """As plain values, for files."""
        return {
            "name": self.name,
            "visibility": self.visibility,
            **(_shape_to_json(self.shape) if self.shape else {"area": 0}),
            "parts": {part: _shape_to_json(shape) for part, shape in self.parts.items()},
            "keypoints": {name: [point.x, point.y, point.visibility] for name, point in self.keypoints.items()},
            "camera_from_instrument": self.camera_from_instrument,
        }


@torch.no_grad()
def annotate(scene: Scene, drawing: LayeredDrawing, names: tuple[tuple[str, str], ...]) -> list[InstrumentLabel]:
    """Labels of every instrument of the drawn state; `names` are the (instrument, part) of the drawing's part ids."""
    keypoints = scene.keypoints(drawing.state)
    drawn_at = scene.registered(drawing.state)  # the pose that agrees with the pixels
    parts = drawing.parts.numpy()
    camera_from_world = np.linalg.inv(to_numpy(drawing.camera.world_from_camera))
    labels = []
    for instrument in instruments_of(names):
        if instrument not in drawing.state.instruments:
            continue
        masks = {part: parts == k + 1 for k, (owner, part) in enumerate(names) if owner == instrument}
        whole = np.any(list(masks.values()), axis=0)
        pose = camera_from_world @ to_numpy(drawn_at.instruments[instrument].pose)
        labels.append(
            InstrumentLabel(
                name=instrument,
                shape=shape_of(whole),
                visibility=visibility(whole, drawing.alone[instrument].mask),
                parts={part: shape for part, mask in masks.items() if (shape := shape_of(mask))},
                keypoints=project_keypoints(keypoints.get(instrument, {}), drawing, instrument),
                camera_from_instrument=_rounded(pose, 6),
            )
        )
    return labels


def shape_of(mask: np.ndarray) -> Shape | None:
    """Box, minimum-area rectangle and polygons of a mask [H, W]; None when it is empty."""
    rectangle = minimum_rectangle(mask)
    if rectangle is None:
        return None
    return Shape(
        area=int(mask.sum()),
        box=bounding_box(mask),
        rectangle=_rounded(rectangle, 2),
        polygons=[_rounded(polygon, 2) for polygon in outer_polygons(mask)],
    )


def visibility(seen: np.ndarray, alone: np.ndarray) -> float:
    """Share of an instrument's pixels, were nothing else there, that are seen; 0 when it has none."""
    whole = int((seen | alone).sum())
    return round(int(seen.sum()) / whole, 4) if whole else 0.0


def place_in_image(point: np.ndarray, camera: Camera) -> tuple[float, float, float] | None:
    """Position (x, y) px and depth mm of a world point [3] mm; None where the image does not show the place."""
    local = (np.linalg.inv(to_numpy(camera.world_from_camera)) @ np.append(point, 1.0))[:3]
    x, y = project(local, camera.fx, camera.fy, camera.cx, camera.cy, nearest=camera.near)
    seen = local[2] > camera.near and 0 <= x < camera.width and 0 <= y < camera.height
    return (float(x), float(y), float(local[2])) if seen else None


def project_keypoints(points: dict[str, Tensor], drawing: LayeredDrawing, instrument: str) -> dict[str, Keypoint]:
    """Where an instrument's keypoints (world mm) fall, and whether anything stands before them.

    Of an instrument with no pixel even when drawn alone nothing is hidden: its keypoints are not labelled (OUTSIDE).
    """
    camera = drawing.camera
    others = [drawing.tissue_depth] + [alone.depth for name, alone in drawing.alone.items() if name != instrument]
    absent = not drawing.alone[instrument].mask.any()
    projected = {}
    for name in sorted(points, key=lambda known: KEYPOINTS.index(known) if known in KEYPOINTS else len(KEYPOINTS)):
        place = place_in_image(to_numpy(points[name]), camera)
        if absent or place is None:
            projected[name] = Keypoint(0.0, 0.0, OUTSIDE)
            continue
        x, y, z = place
        row, column = int(y), int(x)
        hidden = any(0 < depth[row, column] < z - OTHERS_MM for depth in others)
        hidden |= 0 < drawing.alone[instrument].depth[row, column] < z - SELF_MM
        projected[name] = Keypoint(round(x, 2), round(y, 2), OCCLUDED if hidden else VISIBLE)
    return projected


def _shape_to_json(shape: Shape) -> dict[str, Any]:
    return {"area": shape.area, "box": list(shape.box), "rectangle": shape.rectangle, "polygons": shape.polygons}


def _rounded(values: np.ndarray, digits: int) -> list[list[float]]:
    return (np.round(values, digits) + 0.0).tolist()
