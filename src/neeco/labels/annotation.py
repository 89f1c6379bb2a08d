"""Labels of the instruments in a rendering: boxes, polygons, parts, visibility, keypoints and pose, also as tensors.

Shapes are in pixel edges: the pixel in column x, row y covers [x, x + 1] x [y, y + 1].
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import cv2
import numpy as np
import torch
from torch import Tensor

from neeco.capture.model import State
from neeco.geometry.camera import Camera
from neeco.geometry.projection import project_local
from neeco.labels.drawing import LayeredDrawing, draw_layers, keypoint_arrays, shows_any, surface_depth, to_numpy
from neeco.labels.labellers import CompositedLabels, instruments_of
from neeco.labels.settings import LABELS
from neeco.scene import DrawableScene, GaussianScene
from neeco.scene.gaussian_scene import require_gaussians

SHAFT_ENDS = ("shaft_far", "shaft_near")  # keypoints; all others are of the working end
OUTSIDE, OCCLUDED, VISIBLE = 0, 1, 2  # OUTSIDE: outside the image, or the instrument is not rendered at all


@dataclass(frozen=True)
class Shape:
    """A mask in numbers. Pixel edges: pixel (x, y) covers [x, x + 1] x [y, y + 1]."""

    area: int  # px
    box: tuple[int, int, int, int]  # x, y, width, height, of the extreme pixels
    rectangle: list[list[float]]  # 4 corners of the minimum-area rectangle
    polygons: list[list[list[float]]]  # outer contours, simplified, largest first
    segmentation: list[list[list[float]]]  # polygons that cover exactly its pixels


class Keypoint(NamedTuple):
    """A projected keypoint, px."""

    x: float
    y: float
    visibility: int  # OUTSIDE, OCCLUDED or VISIBLE


@dataclass(frozen=True)
class InstrumentLabel:
    """Labels of one instrument in one image. Contours are computed on access, as networks need none."""

    name: str
    image: np.ndarray  # uint8 [H, W]: part ids
    ids: Mapping[str, int]  # of the instrument's parts
    visibility: float  # visible pixels / pixels of the unoccluded instrument
    keypoints: dict[str, Keypoint]
    camera_from_instrument: list[list[float]]  # 4x4 rigid, mm, OpenCV camera axes

    @cached_property
    def mask(self) -> np.ndarray:
        """Return its visible pixels, [H, W] bool."""
        return shows_any(self.image, tuple(self.ids.values()))

    @cached_property
    def shape(self) -> Shape | None:
        """Return the shape of its visible pixels; None without any."""
        return shape_of(self.mask)

    @cached_property
    def parts(self) -> dict[str, Shape]:
        """Return its visible parts."""
        return {part: shape for part, index in self.ids.items() if (shape := shape_of(self.image == index))}

    def to_json(self) -> dict[str, Any]:
        """Return plain values for files."""
        return {
            "name": self.name,
            "visibility": self.visibility,
            **(vars(self.shape) if self.shape else {"area": 0}),
            "parts": {part: dict(vars(shape)) for part, shape in self.parts.items()},
            "keypoints": dict(self.keypoints),
            "camera_from_instrument": self.camera_from_instrument,
        }


@torch.no_grad()
def annotate(
    scene: GaussianScene, drawing: LayeredDrawing, names: tuple[tuple[str, str], ...]
) -> list[InstrumentLabel]:
    """Return the labels of every instrument of a rendering; names: (instrument, part) of its part ids."""
    drawn_at = scene.registered(drawing.state)  # the pose as rendered
    parts = drawing.parts.numpy()
    labels = []
    for instrument in instruments_of(names):
        if instrument not in drawing.state.instruments:
            continue
        ids = {part: k for k, (owner, part) in enumerate(names, 1) if owner == instrument}
        visible = shows_any(parts, tuple(ids.values()))
        pose = drawing.camera.camera_from_world @ to_numpy(drawn_at.instruments[instrument].pose)
        alone = drawing.layers[instrument]
        depths = [drawing.tissue_depth] + [layer.depth for name, layer in drawing.layers.items() if name != instrument]
        keypoints = {}  # OUTSIDE where the instrument has no pixel, even alone
        for name, point in drawing.keypoints.get(instrument, {}).items():
            keypoints[name] = Keypoint(0.0, 0.0, OUTSIDE)
            if alone.mask.any() and (place := place_in_image(point, drawing.camera)) is not None:
                x, y, z = place
                pixel = int(y), int(x)
                hidden = any(0 < depth[pixel] < z - LABELS.occlusion_mm for depth in depths)
                hidden |= 0 < alone.depth[pixel] < z - LABELS.self_occlusion_mm
                keypoints[name] = Keypoint(round(x, 2), round(y, 2), OCCLUDED if hidden else VISIBLE)
        labels.append(
            InstrumentLabel(
                name=instrument,
                image=parts,
                ids=ids,
                visibility=visibility(visible, alone.mask),
                keypoints=keypoints,
                camera_from_instrument=_rounded(pose, 6),
            )
        )
    return labels


def shape_of(mask: np.ndarray) -> Shape | None:
    """Return box, minimum-area rectangle and polygons of a mask [H, W]; None when it is empty."""
    rectangle = minimum_rectangle(mask)
    if rectangle is None:
        return None
    polygons, exact = ([_rounded(polygon, 2) for polygon in find(mask)] for find in (outer_polygons, exact_polygons))
    return Shape(cv2.countNonZero(mask.view(np.uint8)), bounding_box(mask), _rounded(rectangle, 2), polygons, exact)


def visibility(visible: np.ndarray, unoccluded: np.ndarray) -> float:
    """Return the share of an instrument's unoccluded pixels that are visible; 0 when it has none."""
    whole = int((visible | unoccluded).sum())
    return round(int(visible.sum()) / whole, 4) if whole else 0.0


def place_in_image(point: np.ndarray, camera: Camera) -> tuple[float, float, float] | None:
    """Return position (x, y) px and depth mm of a world point [3] mm; None if it is outside the image."""
    local = (camera.camera_from_world @ np.append(point, 1.0))[:3]
    x, y = project_local(local, camera, nearest=camera.near)
    inside = local[2] > camera.near and 0 <= x < camera.width and 0 <= y < camera.height
    return (float(x), float(y), float(local[2])) if inside else None


@torch.no_grad()
def keypoint_names(scene: GaussianScene) -> tuple[str, ...]:
    """Return the names of all keypoints of the scene's instruments."""
    if not scene.recorded.states:
        return ()
    keypoints = scene.keypoints(scene.recorded.states[0]).values()
    return tuple(dict.fromkeys(name for points in keypoints for name in points))


def working_ends_of(keypoints: Mapping[str, Mapping[str, np.ndarray]]) -> dict[str, list[np.ndarray]]:
    """Return the pivots and tips [3] mm among keypoints, of every instrument that has any."""
    ends = {
        instrument: [point for name, point in points.items() if name not in SHAFT_ENDS]
        for instrument, points in keypoints.items()
    }
    return {instrument: points for instrument, points in ends.items() if points}


def working_ends_or_origins(scene: GaussianScene, state: State) -> dict[str, list[np.ndarray]]:
    """Return the `working_ends_of` a scene; if there are none, every instrument's origin [3] mm."""
    return working_ends_of(keypoint_arrays(scene, state)) or {
        name: [to_numpy(item.pose[:3, 3])] for name, item in scene.registered(state).instruments.items()
    }


def any_in_image(camera: Camera, points: Mapping[str, Sequence[np.ndarray]]) -> bool:
    """Return whether any of the instruments' points [3] mm (world) projects into the image."""
    return any(place_in_image(point, camera) is not None for some in points.values() for point in some)


def bounding_box(mask: np.ndarray) -> tuple[int, int, int, int]:
    """Return the box (x, y, width, height) of the extreme pixels of a mask [H, W]; all 0 for an empty mask."""
    x, y, width, height = cv2.boundingRect(mask.view(np.uint8))
    return x, y, width, height


def minimum_rectangle(mask: np.ndarray) -> np.ndarray | None:
    """Return the corners [4, 2] (x, y) of the minimum-area rectangle of a mask's pixels; None when it is empty.

    The direction is OpenCV's, the extent is computed here: cv2.minAreaRect works in float32 and may exclude corners of
    pixels.
    """
    left, top, width, height = bounding_box(mask)
    if not width:
        return None
    inside = mask[top : top + height, left : left + width]
    # the first and last pixel of every row determine the hull
    rows = np.flatnonzero(inside.any(1))
    first = left + inside[rows].argmax(1)
    last = left + width - inside[rows, ::-1].argmax(1)
    rows += top
    corners = np.concatenate([np.stack([x, rows + dy], 1) for x in (first, last) for dy in (0, 1)]).astype(float)
    rectangles = []
    for turn in (0.0, np.radians(cv2.minAreaRect(corners.astype(np.float32))[2])):
        axes = np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
        (low_u, low_v), (high_u, high_v) = (find(corners @ axes.T, axis=0) for find in (np.min, np.max))
        ends = np.array([[low_u, low_v], [high_u, low_v], [high_u, high_v], [low_u, high_v]])
        rectangles.append(((high_u - low_u) * (high_v - low_v), ends @ axes))
    return min(rectangles, key=lambda rectangle: rectangle[0])[1]


def outer_polygons(mask: np.ndarray) -> list[np.ndarray]:
    """Return the simplified outer contour [P, 2] (x, y) of every component of a mask, largest first."""
    polygons = [_simplified(loop) for loop in _outer_loops(mask)[0]]
    return sorted(polygons, key=lambda polygon: -abs(signed_area(polygon)))


def exact_polygons(mask: np.ndarray) -> list[np.ndarray]:
    """Return polygons [P, 2] (x, y) on pixel edges that together cover exactly the pixels of a mask, which is cut below
    the top row of every hole, so that no piece has one."""
    loops, cuts = _outer_loops(mask)
    if cuts:
        bands = zip([0, *cuts], np.split(mask, cuts), strict=True)
        loops = [loop + np.array([0, top]) for top, band in bands for loop in _outer_loops(band)[0]]
    return [_approximated(loop, 1e-6) for loop in loops]  # without collinear corners


def signed_area(polygon: np.ndarray) -> float:
    """Return the area of a polygon [P, 2], positive when it is clockwise in the image (y down)."""
    x, y = np.concatenate([polygon, polygon[:1]]).T
    return float(0.5 * np.sum(x[:-1] * y[1:] - x[1:] * y[:-1]))


def _outer_loops(mask: np.ndarray) -> tuple[list[np.ndarray], list[int]]:
    """Return a closed loop of corners [P, 2] (x, y) for every (edge-connected) component of a mask, on pixel edges, and
    the rows below the top rows of its holes, sorted.

    OpenCV's contours join pixel centres, and pixels that touch at a corner only. In a magnified mask every centre has
    one nearest corner; pixels that touch only at a corner are separated.
    """
    x, y, width, height = bounding_box(mask)
    if not width:
        return [], []
    inside = mask[y : y + height, x : x + width].astype(np.uint8)
    fine = inside.repeat(LABELS.magnification, 0).repeat(LABELS.magnification, 1)
    upper_left, upper_right = inside[:-1, :-1], inside[:-1, 1:]
    lower_left, lower_right = inside[1:, :-1], inside[1:, 1:]
    touching = (upper_left == lower_right) & (upper_right == lower_left) & (upper_left != upper_right)
    for row, column in LABELS.magnification * (np.argwhere(touching) + 1):
        fine[row - 1 : row + 1, column - 1 : column + 1] = 0
    contours, hierarchy = cv2.findContours(fine, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
    loops, holes = [], set()
    for contour, (*_, parent) in zip(contours[::-1], hierarchy[0][::-1], strict=True):
        if parent >= 0:  # a hole, along the pixels about it
            holes.add(y + int(contour[:, 0, 1].min() + 1) // LABELS.magnification + 1)
            continue
        corners = (contour[::-1, 0] + LABELS.magnification // 2) // LABELS.magnification  # clockwise in the image
        corners = corners[(corners != np.roll(corners, 1, axis=0)).any(1)]
        first = np.lexsort(corners.T)[0]  # the leftmost of the top row
        loops.append(np.roll(corners, -first, axis=0) + np.array([x, y], dtype=float))
    return loops, sorted(holes)


def _simplified(loop: np.ndarray) -> np.ndarray:
    """Return a loop with fewer corners (Douglas and Peucker 1973) whose area changes by at most `max_area_change`."""
    area = signed_area(loop)
    tolerance = LABELS.simplify_px
    while tolerance > 0.1:
        simple = _approximated(loop, tolerance)
        if len(simple) >= 3 and abs(signed_area(simple) - area) <= LABELS.max_area_change * area:
            return simple
        tolerance /= 2
    return _approximated(loop, 1e-6)  # removes collinear corners only


def _approximated(loop: np.ndarray, tolerance: float) -> np.ndarray:
    """Return a polygon's corners [P, 2] within `tolerance` px of a closed loop [N, 2]."""
    return cv2.approxPolyDP(loop.astype(np.float32)[:, None], tolerance, True)[:, 0].astype(float)


def _rounded(values: np.ndarray, digits: int) -> list[list[float]]:
    return (np.round(values, digits) + 0.0).tolist()


@dataclass(frozen=True)
class RGBDImage:
    """An image and its depth, on the CPU."""

    image: Tensor  # float32 [H, W, 3] in [0, 1], sRGB
    depth: Tensor  # float32 [H, W] mm along the optical axis, 0 = nothing opaque

    def __repr__(self) -> str:
        return f"RGBDImage({self.image.shape[1]}x{self.image.shape[0]} px)"


@dataclass(frozen=True, kw_only=True)
class LabelledImage(RGBDImage):
    """An image with the labels of the I instruments that it shows, in the order of the scene's instruments.

    Boxes and keypoints are in px, pixel edges: pixel (x, y) covers [x, x + 1] x [y, y + 1].
    """

    parts: Tensor  # uint8 [H, W]: 0 tissue, else part_names[id - 1]
    ignore: Tensor  # bool [H, W]: pixels that a loss should ignore (uncertain edges, unobserved surfaces)
    instruments: tuple[str, ...]  # names of the I instruments
    masks: Tensor  # bool [I, H, W]
    boxes: Tensor  # float32 [I, 4]: left, top, right, bottom
    keypoints: Tensor  # float32 [I, K, 3]: x, y, and 2 visible, 1 occluded, 0 absent (as COCO)
    poses: Tensor  # float32 [I, 4, 4] camera_from_instrument, mm, OpenCV axes (x right, y down, z forward)
    part_names: tuple[tuple[str, str], ...]  # (instrument, part) of part id 1, 2, ...
    keypoint_names: tuple[str, ...]  # of the K keypoints

    def __repr__(self) -> str:
        names = ", ".join(self.instruments) or "no instruments"
        return f"LabelledImage({self.image.shape[1]}x{self.image.shape[0]} px, {names})"

    @classmethod
    def from_drawing(
        cls,
        drawing: LayeredDrawing,
        labels: Sequence[InstrumentLabel],
        part_names: tuple[tuple[str, str], ...],
        keypoint_names: tuple[str, ...],
    ) -> LabelledImage:
        """Return a labelled image from a rendering and the `labels` of `annotate`."""
        visible = [label for label in labels if label.mask.any()]
        parts, count = drawing.parts, len(visible)
        boxes = [(x, y, x + width, y + height) for x, y, width, height in (bounding_box(one.mask) for one in visible)]
        keypoints = [[label.keypoints.get(name, (0, 0, 0)) for name in keypoint_names] for label in visible]
        masks = [torch.from_numpy(label.mask) for label in visible]
        poses = np.array([label.camera_from_instrument for label in visible])
        return cls(
            image=drawing.image.float(),
            depth=torch.from_numpy(drawing.depth).float(),
            parts=parts,
            ignore=drawing.ignored,
            instruments=tuple(label.name for label in visible),
            masks=torch.stack(masks) if masks else torch.zeros((0, *parts.shape), dtype=torch.bool),
            boxes=torch.tensor(boxes, dtype=torch.float32).reshape(count, 4),
            keypoints=torch.tensor(keypoints, dtype=torch.float32).reshape(count, len(keypoint_names), 3),
            poses=torch.from_numpy(poses).float().reshape(count, 4, 4),
            part_names=part_names,
            keypoint_names=keypoint_names,
        )

    def targets(self) -> dict[str, Tensor]:
        """Return the tensors for torchvision's detection models: image float32 [3, H, W], and `labels` int64 [I],
        counted from 1 in the order of the scene's instruments; others as they are, by the names of their fields."""
        classes = instruments_of(self.part_names)
        return {
            "image": self.image.permute(2, 0, 1).contiguous(),
            "parts": self.parts,
            "masks": self.masks,
            "labels": torch.tensor([1 + classes.index(name) for name in self.instruments], dtype=torch.int64),
            "boxes": self.boxes,
            "keypoints": self.keypoints,
            "poses": self.poses,
            "depth": self.depth,
            "ignore": self.ignore,
        }


@torch.no_grad()
def draw_labelled(scene: DrawableScene, state: State, camera: Camera, labels: bool = True) -> RGBDImage:
    """Render `state` for a camera; the result is a `LabelledImage` with `labels`, an `RGBDImage` without.

    Poses may be NumPy arrays or tensors: world_from_instrument and world_from_camera [4, 4], mm, OpenCV axes.

        run = load_run("runs/liver")
        state, camera = sample_states(run, 1)[0]
        rendering = draw_labelled(run.scene, state, camera)
        rendering.image, rendering.masks, rendering.boxes  # [H, W, 3], [I, H, W], [I, 4]

    Raises NeecoError where the state lacks an instrument or joint of the scene; and with `labels` where the scene's
    method learns none.
    """
    if not labels:
        rendering = scene.render(state, scene.recorded.as_learned(camera))
        depth = torch.from_numpy(surface_depth(rendering)).float()
        return RGBDImage(rendering.color.clamp(0, 1).cpu(), depth)
    gaussians = require_gaussians(scene, "render labels")
    labeller = CompositedLabels(gaussians)
    drawing = draw_layers(gaussians, labeller, state, camera, LABELS.min_component)
    annotations = annotate(gaussians, drawing, labeller.names)
    return LabelledImage.from_drawing(drawing, annotations, labeller.names, keypoint_names(gaussians))
