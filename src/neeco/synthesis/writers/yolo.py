"""YOLO: detect, segment, pose and oriented-box label files that Ultralytics-style tools read.

Such tools find an image's labels by replacing the last `/images/` of its path by `/labels/`, so every variant has an
`images` folder of its own next to its `labels`: hard links to the data set's images (copies where the file system has
no hard links), never symbolic ones.

    yolo/{data.yaml, images/{train,val}, labels/{train,val}}     detect
    yolo/segment/…   yolo/pose/…   yolo/obb/…                    the same for the other tasks
    yolo/parts/…                                                 parts as classes, to segment or to detect

Classes are instruments; those of yolo/parts/ are the part ids of dataset.json, less one.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from neeco.base.files import write_text, write_unsynced
from neeco.synthesis.writers import Writer, WrittenImages, link, stem

Row = Callable[[dict[str, Any], np.ndarray], list[float]]  # (label, image size [2]) -> numbers after the class
MAX_SHARE = 1.01  # of the image's width and height: Ultralytics rejects labels that extend further
Shapes = list[tuple[int, dict[str, Any]]]  # class and label of all that an image shows


class Yolo(Writer):
    """Boxes, polygons, keypoints and oriented boxes; coordinates are shares of the image's width and height."""

    format = "yolo"
    description = (
        "`yolo/` to detect, `yolo/segment/`, `yolo/pose/` and `yolo/obb/`; `yolo/parts/` with parts as classes. "
        "Polygons are simplified to 0.8 px, their holes filled and their pieces joined; readers that fill them with "
        "OpenCV add up to half a pixel all around, which is up to a third of a thin jaw at native size: for exact "
        "pixels take `masks`, `parts` or COCO"
    )

    def write(self, images: WrittenImages) -> None:
        """(Re)write every variant. Raises NeecoError."""
        keypoints, folder = images.keypoint_names, images.root / self.format
        visible: list[Shapes] = [  # of every image
            [(images.instruments.index(label["name"]), label) for label in record["labels"] if label["area"] > 0]
            for record in images.records
        ]
        parts: list[Shapes] = [
            [
                (images.part_names.index((label["name"], part)), shape)
                for label in record["labels"]
                for part, shape in label["parts"].items()
            ]
            for record in images.records
        ]
        _write_variant(images, folder, detect_row, {}, visible)
        _write_variant(images, folder / "segment", segment_row, {}, visible)
        _write_variant(images, folder / "obb", oriented_row, {}, visible)
        names = {k: f"{instrument}/{part}" for k, (instrument, part) in enumerate(images.part_names)}
        _write_variant(images, folder / "parts", segment_row, {"names": names}, parts)
        if keypoints:
            swapped = {"left": "right", "right": "left"}
            mirrored = [re.sub("left|right", lambda found: swapped[found[0]], name) for name in keypoints]
            flip = [keypoints.index(name) if name in keypoints else k for k, name in enumerate(mirrored)]
            extra: dict[str, Any] = {"kpt_shape": [len(keypoints), 3], "flip_idx": flip}
            extra["kpt_names"] = {k: list(keypoints) for k in range(len(images.instruments))}

            def pose_row(label: dict[str, Any], size: np.ndarray) -> list[float]:
                points = np.array([label["keypoints"].get(name, [0, 0, 0]) for name in keypoints], dtype=float)
                points[:, :2] /= size
                return detect_row(label, size) + points.ravel().tolist()

            _write_variant(images, folder / "pose", pose_row, extra, visible)


def detect_row(label: dict[str, Any], size: np.ndarray) -> list[float]:
    """Box centre and size."""
    x, y, width, height = label["box"]
    return [*(np.array([x + width / 2, y + height / 2]) / size), *(np.array([width, height]) / size)]


def segment_row(label: dict[str, Any], size: np.ndarray) -> list[float]:
    """Return one polygon; the visible pieces of an instrument are joined by bridges of no width."""
    joined = joined_polygon([np.array(polygon) for polygon in label["polygons"]])
    return np.clip(joined / size, 0, 1).ravel().tolist()


def oriented_row(label: dict[str, Any], size: np.ndarray) -> list[float]:
    """Corners of the minimum-area rectangle of the visible pixels, some outside the image where the border cuts them;
    of their box where Ultralytics would reject the rectangle for its extent."""
    corners = np.array(label["rectangle"]) / size
    low, high = corners.min(0), corners.max(0)
    if (high - low).max() > MAX_SHARE or min((low + high) / 2) < 0 or max((low + high) / 2) > 1:
        x, y, width, height = label["box"]
        corners = np.array([[x, y], [x + width, y], [x + width, y + height], [x, y + height]]) / size
    return corners.ravel().tolist()


def joined_polygon(polygons: list[np.ndarray]) -> np.ndarray:
    """Return one polygon [P, 2] out of several, joined by bridges of no width between their nearest corners."""
    joined, *remaining = polygons
    while remaining:
        gaps = [np.linalg.norm(joined[:, None] - other[None], axis=2) for other in remaining]
        nearest = int(np.argmin([gap.min() for gap in gaps]))
        place, place_in_other = np.unravel_index(gaps[nearest].argmin(), gaps[nearest].shape)
        other = np.roll(remaining.pop(nearest), -int(place_in_other), axis=0)
        joined = np.concatenate([joined[: place + 1], other, other[:1], joined[place:]])
    return joined


def _write_variant(
    images: WrittenImages, folder: Path, row: Row, extra: dict[str, Any], shapes: Sequence[Shapes]
) -> None:
    records = images.records
    for record, shown in zip(records, shapes, strict=True):
        name, split = stem(record["index"]), record["split"]
        size = np.array([record["width"], record["height"]], dtype=float)
        lines = [
            " ".join([str(category), *(f"{value:.6g}" for value in row(shape, size))]) for category, shape in shown
        ]
        write_unsynced(folder / "labels" / split / f"{name}.txt", "".join(f"{line}\n" for line in lines).encode())
        link(images.root / record["image"], folder / "images" / split / Path(record["image"]).name)
    # without "path", tools take the folder of data.yaml itself, wherever the data set is moved
    data = {
        "train": "images/train",
        "val": "images/val" if any(record["split"] == "val" for record in records) else "images/train",
        "names": dict(enumerate(images.instruments)),
        **extra,
    }
    write_text(folder / "data.yaml", yaml.safe_dump(data, sort_keys=False))
