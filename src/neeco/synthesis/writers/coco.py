"""COCO: `coco/instances.json` (one annotation per instrument) and `coco/parts.json` (one per part)."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from neeco.files import write_json
from neeco.synthesis.writers.folder import Record

FOLDER = "coco"


def write_coco(
    root: Path,
    records: Sequence[Record],
    instruments: Sequence[str],
    keypoints: Sequence[str],
    bones: Sequence[tuple[str, str]],
) -> None:
    """Write both COCO files. `file_name` is relative to the data set's images/ folder.

    `bones` are pairs of keypoints that a line joins. Instruments have keypoints in the order of `keypoints` (all of
    them, absent ones as 0 0 0) and, beyond COCO's own fields, `visibility`, `rectangle` (minimum-area, 4 corners) and
    `camera_from_instrument` (4x4, mm, OpenCV axes).
    """
    skeleton = [[keypoints.index(a) + 1, keypoints.index(b) + 1] for a, b in bones if {a, b} <= set(keypoints)]
    categories: list[dict[str, Any]] = [
        {"id": k + 1, "name": name, "supercategory": "instrument"} for k, name in enumerate(instruments)
    ]
    for category in categories if keypoints else []:
        category |= {"keypoints": list(keypoints), "skeleton": skeleton}
    numbers = {category["name"]: category["id"] for category in categories}
    write_json(
        root / FOLDER / "instances.json",
        _document(records, categories, (_instrument(r, label, numbers, keypoints) for r, label in _labels(records))),
    )

    found = [(record, label, part) for record, label in _labels(records) for part in label["parts"]]
    kinds = sorted({(label["name"], part) for _, label, part in found})
    part_numbers = {kind: k + 1 for k, kind in enumerate(kinds)}
    part_categories = [
        {"id": number, "name": f"{name}/{part}", "supercategory": name} for (name, part), number in part_numbers.items()
    ]
    annotations = (
        _annotation(record, label["parts"][part], part_numbers[label["name"], part]) for record, label, part in found
    )
    write_json(root / FOLDER / "parts.json", _document(records, part_categories, annotations))


def _labels(records: Sequence[Record]) -> Iterable[tuple[Record, dict[str, Any]]]:
    return ((record, label) for record in records for label in record["labels"] if label["area"] > 0)


def _document(
    records: Sequence[Record], categories: list[dict[str, Any]], annotations: Iterable[dict[str, Any]]
) -> dict[str, Any]:
    images = [
        {
            "id": record["index"] + 1,  # some tools take 0 for "no image"
            "file_name": Path(record["image"]).name,
            "width": record["width"],
            "height": record["height"],
            "split": record["split"],
        }
        for record in records
    ]
    return {
        "info": {"description": "made by neeco; see dataset.json"},
        "licenses": [],
        "images": images,
        "categories": categories,
        "annotations": [{"id": k + 1} | annotation for k, annotation in enumerate(annotations)],
    }


def _annotation(record: Record, shape: dict[str, Any], category: int) -> dict[str, Any]:
    return {
        "image_id": record["index"] + 1,
        "category_id": category,
        "segmentation": [np.ravel(polygon).tolist() for polygon in shape["polygons"]],
        "bbox": shape["box"],
        "area": shape["area"],
        "iscrowd": 0,
        "rectangle": shape["rectangle"],
    }


def _instrument(
    record: Record, label: dict[str, Any], numbers: dict[str, int], keypoints: Sequence[str]
) -> dict[str, Any]:
    annotation = _annotation(record, label, numbers[label["name"]])
    points = [label["keypoints"].get(name, [0, 0, 0]) for name in keypoints]
    if keypoints:
        annotation["keypoints"] = [value for point in points for value in point]
        annotation["num_keypoints"] = sum(point[2] > 0 for point in points)
    annotation["visibility"] = label["visibility"]
    annotation["camera_from_instrument"] = label["camera_from_instrument"]
    return annotation
