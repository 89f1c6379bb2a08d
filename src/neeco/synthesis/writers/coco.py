"""COCO: one annotation per instrument (instances) and one per part (parts), of all images and of each split.

    coco/images/                                images (hard links); every `file_name` is relative to it
    coco/{instances,parts}.json                 all images
    coco/annotations/{instances,parts}_{train,val}.json    one split each, where readers of COCO look for them
    coco/rle/{instances,parts}.json             all images, with run lengths for polygons

Category ids of parts are the part ids of dataset.json and of parts/, whether an image shows the part or not.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from neeco.base.files import write_json
from neeco.capture.images import read_labels
from neeco.synthesis.writers import CONTACT, Record, Writer, WrittenImages, link, stem

Entry = dict[str, Any]


class Coco(Writer):
    """Boxes, polygons, keypoints and poses of instruments and their parts.

    Instruments have all keypoints, absent ones as 0 0 0, and, beyond COCO's own fields, `visibility`, `rectangle`
    (minimum-area, 4 corners), `camera_from_instrument` (4x4, mm, OpenCV axes) and `attributes` (contact with tissue).
    """

    format = "coco"
    description = (
        "`coco/instances.json` (boxes, polygons, keypoints, 6-DoF poses) and `coco/parts.json`; each split in "
        "`coco/annotations/`, images in `coco/images/`; `coco/rle/` has run lengths instead of polygons, for readers "
        "that fill polygons with OpenCV, which adds up to a pixel"
    )

    def write(self, images: WrittenImages) -> None:
        """(Re)write all COCO files. Raises NeecoError."""
        keypoints, records = images.keypoint_names, images.records
        bones = [pair for pair in images.bones if set(pair) <= set(keypoints)]
        skeleton = [[keypoints.index(a) + 1, keypoints.index(b) + 1] for a, b in bones]
        shared: Entry = {"supercategory": "instrument"}
        if keypoints:
            shared |= {"keypoints": list(keypoints), "skeleton": skeleton}
        instruments = [{"id": k, "name": name, **shared} for k, name in enumerate(images.instruments, 1)]
        parts = [
            {"id": k, "name": f"{instrument}/{part}", "supercategory": instrument}
            for k, (instrument, part) in enumerate(images.part_names, 1)
        ]
        numbers = {category["name"]: category["id"] for category in instruments}
        part_numbers = {name: k for k, name in enumerate(images.part_names, 1)}
        folder = images.root / self.format
        for record in records:
            link(images.root / record["image"], folder / "images" / Path(record["image"]).name)
        for split in (None, *sorted({record["split"] for record in records})):
            chosen = [record for record in records if split in (None, record["split"])]
            entries = [
                {
                    "id": record["index"] + 1,  # some tools take 0 for "no image"
                    "file_name": Path(record["image"]).name,
                    "width": record["width"],
                    "height": record["height"],
                    "split": record["split"],
                }
                for record in chosen
            ]
            visible = [(record, label) for record in chosen for label in record["labels"] if label["area"] > 0]
            exact = _exact_masks(images, visible) if split is None else {}
            by_instrument = (_instrument(record, label, numbers, keypoints) for record, label in visible)
            by_part = (
                _annotation(record, shape, part_numbers[label["name"], part])
                for record, label in visible
                for part, shape in label["parts"].items()
            )
            for kind, categories, made in (("instances", instruments, by_instrument), ("parts", parts, by_part)):
                path = folder / (f"{kind}.json" if split is None else f"annotations/{kind}_{split}.json")
                document: Entry = {
                    "info": {"description": "made by neeco; see dataset.json"},
                    "licenses": [],
                    "images": entries,
                    "categories": categories,
                    "annotations": [{"id": k + 1} | annotation for k, annotation in enumerate(made)],
                }
                write_json(path, document, indent=None)
                if split is None:
                    for annotation, runs in zip(document["annotations"], exact[kind], strict=True):
                        annotation["segmentation"] = runs
                    write_json(folder / "rle" / f"{kind}.json", document, indent=None)


def _exact_masks(images: WrittenImages, visible: Sequence[tuple[Record, Entry]]) -> dict[str, list[Entry]]:
    """Return the run lengths of all instances that are visible, and of their parts, by kind."""
    runs: dict[str, list[Entry]] = {"instances": [], "parts": []}
    record, ids = None, np.zeros((0, 0), np.uint8)
    for owner, label in visible:
        if owner is not record:
            record, ids = owner, read_labels(images.root / "parts" / f"{stem(owner['index'])}.png").numpy()
        numbers = {part: k for k, (name, part) in enumerate(images.labeller.names, 1) if name == label["instrument"]}
        runs["instances"].append(run_lengths(np.isin(ids, [*numbers.values()])))
        runs["parts"] += [run_lengths(ids == numbers[part]) for part in label["parts"]]
    return runs


def run_lengths(mask: np.ndarray) -> Entry:
    """Return COCO's uncompressed run lengths of a mask bool [H, W]: down the columns, from what is outside on."""
    flat = mask.T.ravel()
    changes = np.flatnonzero(np.diff(flat)) + 1
    counts = np.diff([0, *changes, flat.size]).tolist()
    return {"size": list(mask.shape), "counts": [0, *counts] if flat[0] else counts}


def _annotation(record: Record, shape: Entry, category: int) -> Entry:
    return {
        "image_id": record["index"] + 1,
        "category_id": category,
        "segmentation": [np.ravel(polygon).tolist() for polygon in shape["segmentation"]],
        "bbox": shape["box"],
        "area": shape["area"],
        "iscrowd": 0,
        "rectangle": shape["rectangle"],
    }


def _instrument(record: Record, label: Entry, numbers: dict[str, int], keypoints: Sequence[str]) -> Entry:
    annotation = _annotation(record, label, numbers[label["name"]])
    if keypoints:
        points = [label["keypoints"].get(name, [0, 0, 0]) for name in keypoints]
        annotation["keypoints"] = [value for point in points for value in point]
        annotation["num_keypoints"] = sum(point[2] > 0 for point in points)
    annotation["visibility"] = label["visibility"]
    annotation["attributes"] = {key: label[key] for key in CONTACT if key in label}
    annotation["camera_from_instrument"] = label["camera_from_instrument"]
    return annotation
