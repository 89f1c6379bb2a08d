"""What dataset hubs and their libraries read: the dataset card README.md, `imagefolder/` and WebDataset shards.

README.md                                    the card: YAML front matter (Hugging Face's), then how the set was made
imagefolder/{train,validation}/metadata.jsonl beside the images and their masks:
                                             datasets.load_dataset("imagefolder", data_dir="DATASET/imagefolder")
webdataset/{train,val}-NNNNNN.tar            samples read in a row, a sample's files with its number as key: .png or
                                             .jpg (image), .mask.png, .parts.png, .ignore.png, .depth.png and .json
                                             (its record: state, camera, labels)
"""

from __future__ import annotations

import io
import json
import shlex
import tarfile
from collections.abc import Mapping, Sequence
from dataclasses import fields
from functools import partial
from pathlib import Path
from typing import Any

import yaml

from neeco.files import write_atomically, write_text
from neeco.synthesis.settings import ImageSettings, Settings
from neeco.synthesis.writers.folder import Record, link, public_record, stem

IMAGEFOLDER, WEBDATASET = "imagefolder", "webdataset"
SPLITS = {"train": "train", "val": "validation"}  # ours, and what the hub calls them
SHARD_SIZE = 1000  # samples in a tar file
SHARDED = {"masks": "mask.png", "parts": "parts.png", "ignore": "ignore.png", "depth": "depth.png"}

CARD = "README.md"
MARK = "<!-- Written by neeco, which writes it anew with --resume. Remove this line to keep your own text. -->"
SIZES = {"n<1K": 10**3, "1K<n<10K": 10**4, "10K<n<100K": 10**5, "100K<n<1M": 10**6, "1M<n<10M": 10**7}
TASKS = ["image-segmentation", "object-detection", "keypoint-detection", "depth-estimation"]
TAGS = ["surgical-instruments", "endoscopy", "6d-pose-estimation", "gaussian-splatting"]
SYNTHETIC = """The images were drawn by a Gaussian-splatting model learned from a recording, in states of the
instruments that were not recorded. Labels come from the same model: exact for what is drawn."""
RECORDED = """The images were recorded. Their labels were drawn by a Gaussian-splatting model of the recording, at poses
fitted to each image; images whose labels could not be trusted were left out."""
TEXT = """---
{front}---

{mark}

# {title}

{how}

{images} images ({splits}). The publisher of the set states its license.

## Classes

| part id | instrument | part |
|---|---|---|
{classes}

Keypoints, where an instrument has them: {keypoints}.

## Files

- `images`: the images, RGB
- `masks`: instrument or not: 255 or 0
- `soft`: share of a pixel that is instrument, in counts of 1/255
- `ignore`: 255 where a loss had better ignore the pixel: uncertain edges, and what no training frame saw
- `parts`: part ids, see above
- `depth`: 16 bit, in counts of {mm_per_count} mm; 0 is none
- `silhouettes`: bit k is set where instrument k would be seen if nothing else were there
- `states.jsonl`: one line per image: instrument states (mm, rad), camera (OpenGL axes), intrinsics, labels
- `dataset.json`: how the set was made, in full
- `preview.png`: a look at the labels
{formats}

## How it was made

By neeco {version}, of a scene with SHA-256 `{scene}`:

    {command}
"""
FORMATS = {
    "coco": "- `coco/instances.json` (boxes, polygons, keypoints, 6-DoF poses) and `coco/parts.json`; each split in "
    "`coco/annotations/`, images in `coco/images/`",
    "yolo": "- `yolo/` to detect, `yolo/segment/`, `yolo/pose/` and `yolo/obb/`",
    "webdataset": "- `webdataset/{train,val}-*.tar`",
    "bop": "- `bop/{train,val}/`, for 6-DoF pose",
    "imagefolder": "- `imagefolder/{train,validation}/`, with metadata.jsonl",
}


def write_card(root: Path, info: Mapping[str, Any]) -> None:
    """Write the dataset card README.md from what dataset.json says (`info`); a README.md of the user's own stays.

    The same data set has the same card: no date, no host. Raises NeecoError.
    """
    path = root / CARD
    if path.exists() and MARK not in path.read_text(encoding="utf-8", errors="replace"):
        return
    annotated = "annotates" in info["settings"]
    title = f"{'Recorded' if annotated else 'Synthetic'} images of surgical instruments, labelled"
    suffix = "png" if info["settings"].get("quality") is None else "jpg"
    config: dict[str, Any] = {
        "config_name": "default",
        "data_files": f"images/*.{suffix}",
    }  # what the hub's viewer shows
    if IMAGEFOLDER in info["formats"]:
        config = {"config_name": "default", "data_dir": IMAGEFOLDER}
    elif WEBDATASET in info["formats"]:
        config["data_files"] = [{"split": SPLITS[k], "path": f"{WEBDATASET}/{k}-*.tar"} for k in info["splits"]]
    front = {
        "license": "unknown",
        "pretty_name": title,
        "task_categories": TASKS,
        "tags": TAGS if annotated else [*TAGS, "synthetic"],
        "size_categories": [next((name for name, limit in SIZES.items() if info["images"] < limit), "n>10M")],
        "configs": [config],
    }
    text = TEXT.format(
        front=yaml.safe_dump(front, sort_keys=False),
        mark=MARK,
        title=title,
        how=RECORDED if annotated else SYNTHETIC,
        images=info["images"],
        splits=", ".join(f"{count} {split}" for split, count in info["splits"].items()),
        classes="\n".join(f"| {item['id']} | {item.get('instrument', '')} | {item['part']} |" for item in info["ids"]),
        keypoints=", ".join(info["keypoints"]) or "none",
        mm_per_count=info["depth"]["mm_per_count"],
        formats="\n".join(FORMATS[name] for name in info["formats"]),
        version=info["version"],
        scene=info["scene_sha256"],
        command=_command(info),
    )
    write_text(path, text)


def _command(info: Mapping[str, Any]) -> str:
    """The command that makes the set again."""
    settings = info["settings"]
    if "annotates" in settings:
        words = ["annotate", info["scene"], "--capture", settings["annotates"], "--min-trust", settings["min_trust"]]
    elif "instruments" in info:
        words = ["synthesize", "--tissue", info["scene"], "--instruments", *info["instruments"]]
    else:
        words = ["synthesize", info["scene"]]
    given = {"count": info["images"] + len(info["skipped"])} | settings
    given |= {"image_format": "png" if given.get("quality") is None else "jpg"}
    for field in fields(Settings if "seed" in settings else ImageSettings):
        value, flag = given.get(field.name), f"--{field.name.replace('_', '-')}"
        value = field.default if value is None else value
        if isinstance(field.default, bool):
            words += [] if value == field.default else [flag if value else f"--no-{flag[2:]}"]
        elif value != field.default or field.name == "seed":
            words += [flag, *(value if isinstance(value, list) else ["FILE"] if isinstance(value, dict) else [value])]
    formats = ["--formats", *info["formats"]] if info["formats"] else []
    return shlex.join(map(str, ["neeco", *words, *formats, "--output", "DATASET"]))


def write_imagefolder(root: Path, records: Sequence[Record], instruments: Sequence[str]) -> None:
    """(Re)write images (hard links) and metadata; objects have `bbox` (x, y, width, height px), `area` px, `category`
    (index into `instruments`) and `name`. Raises NeecoError."""
    lines: dict[str, list[str]] = {}
    for record in records:
        split, name = SPLITS[record["split"]], stem(record["index"])
        image = Path(record["image"]).name
        link(root / record["image"], root / IMAGEFOLDER / split / image)
        link(root / "masks" / f"{name}.png", root / IMAGEFOLDER / split / f"{name}_mask.png")
        seen = [label for label in record["labels"] if label["area"] > 0]
        line = {
            "file_name": image,
            "mask_file_name": f"{name}_mask.png",
            "objects": {
                "bbox": [label["box"] for label in seen],
                "area": [label["area"] for label in seen],
                "category": [instruments.index(label["name"]) for label in seen],
                "name": [label["name"] for label in seen],
            },
        }
        lines.setdefault(split, []).append(json.dumps(line, allow_nan=False))
    for split, of_split in lines.items():
        write_text(root / IMAGEFOLDER / split / "metadata.jsonl", "".join(f"{line}\n" for line in of_split))


def write_webdataset(root: Path, records: Sequence[Record]) -> None:
    """(Re)write the shards; the same data set gives the same bytes. Raises NeecoError."""
    for old in (root / WEBDATASET).glob("*.tar"):
        old.unlink()
    for split in sorted({record["split"] for record in records}):
        chosen = [record for record in records if record["split"] == split]
        for number, start in enumerate(range(0, len(chosen), SHARD_SIZE)):
            path = root / WEBDATASET / f"{split}-{number:06d}.tar"
            write_atomically(path, partial(_write_shard, root, chosen[start : start + SHARD_SIZE]))


def _write_shard(root: Path, records: Sequence[Record], path: Path) -> None:
    with tarfile.open(path, "w", format=tarfile.USTAR_FORMAT) as tar:
        for record in records:
            key = stem(record["index"])
            image = root / record["image"]
            contents = {image.suffix[1:]: image.read_bytes()}
            contents |= {ending: (root / folder / f"{key}.png").read_bytes() for folder, ending in SHARDED.items()}
            contents["json"] = json.dumps(public_record(record), allow_nan=False).encode()
            for ending, content in contents.items():
                entry = tarfile.TarInfo(f"{key}.{ending}")  # dated 1970 and nobody's: bytes depend on content alone
                entry.size = len(content)
                tar.addfile(entry, io.BytesIO(content))
