"""What dataset hubs and their libraries read: the dataset card README.md, `imagefolder/` and WebDataset shards.

README.md                                    the card: YAML front matter (Hugging Face's), then how the set was made
imagefolder/{train,validation}/metadata.jsonl beside the images and their masks:
                                             datasets.load_dataset("imagefolder", data_dir="DATASET/imagefolder")
webdataset/{train,val}-NNNNNN.tar            samples read in a row, a sample's files with its number as key: .png
                                             (image), .mask.png, .parts.png, .ignore.png, .depth.png and .json
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
from neeco.synthesis.settings import Settings
from neeco.synthesis.writers.folder import Record, link, public_record, stem

CARD = "README.md"
MARK = "<!-- Written by neeco, which writes it anew with --resume. Remove this line to keep your own text. -->"
SIZES = {"n<1K": 10**3, "1K<n<10K": 10**4, "10K<n<100K": 10**5, "100K<n<1M": 10**6, "1M<n<10M": 10**7}
TASKS = ["image-segmentation", "object-detection", "keypoint-detection", "depth-estimation"]
TAGS = ["surgical-instruments", "endoscopy", "6d-pose-estimation", "gaussian-splatting"]
IMAGEFOLDER, WEBDATASET = "imagefolder", "webdataset"
SPLITS = {"train": "train", "val": "validation"}  # ours, and what the hub calls them
SHARD_SIZE = 1000  # samples in a tar file
SHARDED = {"images": "png", "masks": "mask.png", "parts": "parts.png", "ignore": "ignore.png", "depth": "depth.png"}
LAYOUT = {
    "images": "the images, RGB",
    "masks": "instrument or not: 255 or 0",
    "soft": "share of a pixel that is instrument, in counts of 1/255",
    "ignore": "255 where a loss had better ignore the pixel: uncertain edges, and what no training frame saw",
    "parts": "part ids, see above",
    "depth": "16 bit, in counts of {mm_per_count} mm; 0 is none",
    "silhouettes": "bit k is set where instrument k would be seen if nothing else were there",
    "states.jsonl": "one line per image: instrument states (mm, rad), camera (OpenGL axes), intrinsics, labels",
    "dataset.json": "how the set was made, in full",
    "preview.png": "a look at the labels",
}
FORMAT_FOLDERS = {
    "coco": "`coco/instances.json` (boxes, polygons, keypoints, 6-DoF poses) and `coco/parts.json`",
    "yolo": "`yolo/` to detect, `yolo/segment/`, `yolo/pose/` and `yolo/obb/`",
    "webdataset": "`webdataset/{train,val}-*.tar`",
    "bop": "`bop/{train,val}/`, for 6-DoF pose",
    "imagefolder": "`imagefolder/{train,validation}/`, with metadata.jsonl",
}


def write_card(root: Path, info: Mapping[str, Any]) -> None:
    """Write the dataset card README.md from what dataset.json says (`info`); a README.md of the user's own stays.

    The same data set has the same card: no date, no host. Raises NeecoError.
    """
    path = root / CARD
    if path.exists() and MARK not in path.read_text(encoding="utf-8", errors="replace"):
        return
    annotated = "annotates" in info["settings"]
    title = "Recorded" if annotated else "Synthetic"
    size = next((name for name, limit in SIZES.items() if info["images"] < limit), "n>10M")
    front = {
        "license": "unknown",
        "pretty_name": f"{title} images of surgical instruments, labelled",
        "task_categories": TASKS,
        "tags": [*TAGS, *([] if annotated else ["synthetic"])],
        "size_categories": [size],
        "configs": [{"config_name": "default"} | _default_config(info)],
    }
    how = (
        "The images were recorded. Their labels were drawn by a Gaussian-splatting model of the recording, at poses "
        "fitted to each image; images whose labels could not be trusted were left out."
        if annotated
        else "The images were drawn by a Gaussian-splatting model learned from a recording, in states of the "
        "instruments that were not recorded. Labels come from the same model: exact for what is drawn."
    )
    splits = ", ".join(f"{count} {split}" for split, count in info["splits"].items())
    lines = [
        f"---\n{yaml.safe_dump(front, sort_keys=False)}---",
        MARK,
        f"# {front['pretty_name']}",
        how,
        f"{info['images']} images ({splits}). The license is for whoever publishes the set to state.",
        "## Classes",
        "\n".join(["| part id | instrument | part |", "|---|---|---|", *(_class_row(item) for item in info["ids"])]),
        f"Keypoints, where an instrument has them: {', '.join(info['keypoints']) or 'none'}.",
        "## Files",
        "\n".join(f"- `{name}`: {text.format(**info['depth'])}" for name, text in LAYOUT.items()),
        "\n".join(f"- {FORMAT_FOLDERS[name]}" for name in info["formats"]),
        "## How it was made",
        f"By neeco {info['version']}, of a scene with SHA-256 `{info['scene_sha256']}`:",
        f"    {_command(info)}",
    ]
    write_text(path, "\n\n".join(line for line in lines if line) + "\n")


def _class_row(item: Mapping[str, Any]) -> str:
    return f"| {item['id']} | {item.get('instrument', '')} | {item['part']} |"


def _default_config(info: Mapping[str, Any]) -> dict[str, Any]:
    """What the hub's viewer and `load_dataset` take when nobody names anything else."""
    if IMAGEFOLDER in info["formats"]:
        return {"data_dir": IMAGEFOLDER}
    if WEBDATASET in info["formats"]:
        return {"data_files": [{"split": SPLITS[s], "path": f"{WEBDATASET}/{s}-*.tar"} for s in info["splits"]]}
    return {"data_files": "images/*.png"}


def _command(info: Mapping[str, Any]) -> str:
    """The command that makes the set again."""
    settings = info["settings"]
    formats = ["--formats", *info["formats"]] if info["formats"] else []
    if "annotates" in settings:
        words = ["annotate", info["scene"], "--capture", settings["annotates"], "--min-trust", settings["min_trust"]]
        return shlex.join(map(str, ["neeco", *words, *formats, "--output", "DATASET"]))
    words = ["synthesize", info["scene"]]
    if "instruments" in info:
        words = ["synthesize", "--tissue", info["scene"], "--instruments", *info["instruments"]]
    words += ["--count", info["images"] + len(info["skipped"]), "--seed", settings["seed"]]
    for field in fields(Settings):
        value = settings.get(field.name, field.default)
        flag = f"--{field.name.replace('_', '-')}"
        if value == field.default or field.name in ("count", "seed"):
            continue
        if field.name == "camera_effects":
            words += [flag, "EFFECTS.yaml"]
        elif isinstance(value, bool):
            words += [flag if value else f"--no-{flag[2:]}"]
        else:
            words += [flag, *(value if isinstance(value, list) else [value])]
    return shlex.join(map(str, ["neeco", *words, *formats, "--output", "DATASET"]))


def write_imagefolder(root: Path, records: Sequence[Record], instruments: Sequence[str]) -> None:
    """(Re)write images (hard links) and metadata; objects have `bbox` (x, y, width, height px), `area` px, `category`
    (index into `instruments`) and `name`. Raises NeecoError."""
    lines: dict[str, list[str]] = {}
    for record in records:
        split, name = SPLITS[record["split"]], stem(record["index"])
        link(root / record["image"], root / IMAGEFOLDER / split / f"{name}.png")
        link(root / "masks" / f"{name}.png", root / IMAGEFOLDER / split / f"{name}_mask.png")
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
            contents = {ending: (root / folder / f"{key}.png").read_bytes() for folder, ending in SHARDED.items()}
            contents["json"] = json.dumps(public_record(record), allow_nan=False).encode()
            for ending, content in contents.items():
                entry = tarfile.TarInfo(f"{key}.{ending}")  # dated 1970 and nobody's: bytes depend on content alone
                entry.size = len(content)
                tar.addfile(entry, io.BytesIO(content))
