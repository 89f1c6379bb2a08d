"""Hugging Face imagefolder: `imagefolder/{train,validation}/metadata.jsonl` beside the images and their masks.

`datasets.load_dataset("imagefolder", data_dir="DATASET/imagefolder")` reads image, mask and objects.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

from neeco.files import write_text
from neeco.synthesis.writers.folder import Record, link, stem

FOLDER = "imagefolder"
SPLITS = {"train": "train", "val": "validation"}  # ours, and what the hub calls them


def write_imagefolder(root: Path, records: Sequence[Record], instruments: Sequence[str]) -> None:
    """(Re)write images (hard links) and metadata; objects have `bbox` (x, y, width, height px), `area` px, `category`
    (index into `instruments`) and `name`. Raises NeecoError."""
    lines: dict[str, list[str]] = {}
    for record in records:
        split, name = SPLITS[record["split"]], stem(record["index"])
        link(root / record["image"], root / FOLDER / split / f"{name}.png")
        link(root / "masks" / f"{name}.png", root / FOLDER / split / f"{name}_mask.png")
        seen = [label for label in record["labels"] if label["area"] > 0]
        line = {
            "file_name": f"{name}.png",
            "mask_file_name": f"{name}_mask.png",
            "objects": {
                "bbox": [label["box"] for label in seen],
                "area": [label["area"] for label in seen],
                "category": [instruments.index(label["name"]) for label in seen],
                "name": [label["name"] for label in seen],
            },
        }
        lines.setdefault(split, []).append(json.dumps(line))
    for split, of_split in lines.items():
        write_text(root / FOLDER / split / "metadata.jsonl", "".join(f"{line}\n" for line in of_split))
