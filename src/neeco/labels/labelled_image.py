"""A labelled image in memory, as tensors that detectors and segmenters take."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, overload

import torch
from torch import Tensor

from neeco.capture.model import State
from neeco.labels.annotation import InstrumentLabel, annotate, keypoint_names
from neeco.labels.drawing import LayeredDrawing, draw_layers, surface_depth
from neeco.labels.labellers import CompositedLabels, instruments_of
from neeco.raster.types import Camera
from neeco.scene.scene import gaussian_scene

if TYPE_CHECKING:
    from neeco.scene import Drawable

MIN_COMPONENT = 0.01  # of an instrument's largest component: smaller ones are not labelled, as by `synthesize`


@dataclass(frozen=True)
class RGBDImage:
    """An image and its depth, on the CPU."""

    image: Tensor  # float32 [H, W, 3] in [0, 1], sRGB
    depth: Tensor  # float32 [H, W] mm along the optical axis, 0 = nothing opaque


@dataclass(frozen=True)
class LabelledImage(RGBDImage):
    """An image with the labels of the I instruments that it shows, in the order of the scene's instruments.

    Boxes and keypoints are in px, pixel edges: pixel (x, y) covers [x, x + 1] x [y, y + 1].
    """

    parts: Tensor  # uint8 [H, W]: 0 tissue, else part_names[id - 1]
    ignore: Tensor  # bool [H, W]: uncertain edges, and what no training frame saw; a loss had better ignore them
    instruments: tuple[str, ...]  # names of the I instruments
    masks: Tensor  # bool [I, H, W]
    boxes: Tensor  # float32 [I, 4]: left, top, right, bottom
    keypoints: Tensor  # float32 [I, K, 3]: x, y, and 2 visible, 1 occluded, 0 absent (as COCO)
    poses: Tensor  # float32 [I, 4, 4] camera_from_instrument, mm, OpenCV axes (x right, y down, z forward)
    part_names: tuple[tuple[str, str], ...]  # (instrument, part) of part id 1, 2, ...
    keypoint_names: tuple[str, ...]  # of the K keypoints

    @classmethod
    def of(
        cls,
        image: Tensor,
        depth: Tensor,
        parts: Tensor,
        ignore: Tensor,
        labels: Sequence[Mapping[str, Any]],
        part_names: tuple[tuple[str, str], ...],
        keypoint_names: tuple[str, ...],
    ) -> LabelledImage:
        """From pixels and the `labels` of a data set's record (`InstrumentLabel.to_json`)."""
        seen = [label for label in labels if label["area"] > 0]
        ids = {name: [k + 1 for k, (owner, _) in enumerate(part_names) if owner == name] for name, _ in part_names}
        masks = [torch.isin(parts, torch.tensor(ids[label["name"]], dtype=parts.dtype)) for label in seen]
        boxes = [(x, y, x + width, y + height) for x, y, width, height in (label["box"] for label in seen)]
        keypoints = [[label["keypoints"].get(name, (0, 0, 0)) for name in keypoint_names] for label in seen]
        count = len(seen)
        return cls(
            image=image.float(),
            depth=depth.float(),
            parts=parts,
            ignore=ignore,
            instruments=tuple(label["name"] for label in seen),
            masks=torch.stack(masks) if masks else torch.zeros((0, *parts.shape), dtype=torch.bool),
            boxes=torch.tensor(boxes, dtype=torch.float32).reshape(count, 4),
            keypoints=torch.tensor(keypoints, dtype=torch.float32).reshape(count, len(keypoint_names), 3),
            poses=torch.tensor([label["camera_from_instrument"] for label in seen]).float().reshape(count, 4, 4),
            part_names=part_names,
            keypoint_names=keypoint_names,
        )

    @classmethod
    def from_drawing(
        cls,
        drawing: LayeredDrawing,
        labels: Sequence[InstrumentLabel],
        part_names: tuple[tuple[str, str], ...],
        keypoint_names: tuple[str, ...],
    ) -> LabelledImage:
        """From a drawing and the `labels` that `annotate` finds in it."""
        values = [label.to_json() for label in labels]
        depth = torch.from_numpy(drawing.depth)
        return cls.of(drawing.image, depth, drawing.parts, drawing.ignored, values, part_names, keypoint_names)

    def targets(self) -> dict[str, Tensor]:
        """As torchvision's detection models take it: image float32 [3, H, W], and `labels` int64 [I], counted from 1 in
        the order of the scene's instruments; the other tensors as they are, by the names of their fields."""
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


@overload
def draw_labelled(scene: Drawable, state: State, camera: Camera, labels: Literal[True] = True) -> LabelledImage: ...
@overload
def draw_labelled(scene: Drawable, state: State, camera: Camera, labels: bool) -> RGBDImage: ...
@torch.no_grad()
def draw_labelled(scene: Drawable, state: State, camera: Camera, labels: bool = True) -> RGBDImage:
    """Draw `state` as `camera` sees it; with `labels` the result is a `LabelledImage`, without an `RGBDImage`.

    Poses may be NumPy arrays or tensors: world_from_instrument and world_from_camera [4, 4], mm, OpenCV axes.

        run = load_run("runs/liver")
        state, camera = sample_states(run, 1)[0]
        drawn = draw_labelled(run.scene, state, camera)
        drawn.image, drawn.masks, drawn.boxes  # [H, W, 3], [I, H, W], [I, 4]

    Raises NeecoError where the state lacks an instrument or joint of the scene; and with `labels` where the scene's
    method learns none.
    """
    if not labels:
        rendering = scene.render(state, camera)
        depth = torch.from_numpy(surface_depth(rendering)).float()
        return RGBDImage(rendering.color.clamp(0, 1).cpu(), depth)
    known = gaussian_scene(scene, "draw labels")
    labeller = CompositedLabels(known)
    drawing = draw_layers(known, labeller, state, camera, MIN_COMPONENT)
    found = annotate(known, drawing, labeller.names)
    return LabelledImage.from_drawing(drawing, found, labeller.names, keypoint_names(known))
