"""The data set as plain files: images, masks, share of instrument, part ids, depth, states, and one record per image;
and the interface of further formats.

A record contains everything about its image and is written last, so an image without a complete record does not exist.
A format is index files made from the records, one format in one file here, by a subclass of `Writer`. Ours are found in
this package, those of other packages by the entry point `neeco.writers`, named as the format.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any, ClassVar

import numpy as np
import torch

from neeco.base.errors import NeecoError
from neeco.base.files import read_bytes, read_text, require_replaceable, write_atomically, write_text, write_unsynced
from neeco.capture.images import encoded_image, encoded_png
from neeco.capture.writer import camera_to_json, state_to_json
from neeco.geometry.lens import Lens
from neeco.labels.drawing import LayeredDrawing, to_numpy
from neeco.labels.labellers import Labeller, instruments_of
from neeco.scene import GaussianScene

Record = dict[str, Any]

DEPTH_MM_PER_COUNT = 0.05  # of 16 bits, 0 = none; saturates at 3276 mm
SHARE_PER_COUNT = 1 / 255
IGNORED = 255
RECORDS = ".records"
CHECKSUM = "sha256"  # of the rest of a record
LABELS = ("masks", "soft", "ignore", "parts", "depth", "silhouettes")  # folders with a PNG of every image
MAX_INSTRUMENTS = 8  # in `silhouettes`: bit k is set where instrument k would be visible if nothing else were there
CONTACT = ("contact", "contact_confidence", "penetration_mm", "contact_box")  # of a label
POLYGONS = ("polygons", "segmentation")  # of a label or part, left out of states.jsonl
FOLDERS = ("images", *LABELS, RECORDS)
VALIDATION_EVERY = 5  # every fifth image is for validation; by the index alone, so a data set can grow


def split_of(index: int) -> str:
    """Return the split of image `index`, "train" or "val"."""
    return "val" if index % VALIDATION_EVERY == VALIDATION_EVERY - 1 else "train"


def stem(index: int) -> str:
    """File stem of image `index`."""
    return f"{index:06d}"


@dataclass(frozen=True)
class Encoded:
    """The record of an image and the content of its files, by their names in the data set."""

    record: Record
    files: Mapping[str, bytes]

    def write(self, root: Path) -> Record:
        """Write the files and then the record to a data set, unsynced; return the record. Raises NeecoError."""
        for name, content in self.files.items():
            write_unsynced(root / name, content)
        content = json.dumps(self.record | {CHECKSUM: _digest(self.record)}, allow_nan=False).encode()
        write_unsynced(record_path(root, self.record["index"]), content)
        return self.record


def encoded_sample(
    index: int,
    drawing: LayeredDrawing,
    labels: list[Record],
    *,
    refused: Mapping[str, int] = MappingProxyType({}),
    facts: Mapping[str, Any] = MappingProxyType({}),
    quality: int | None = None,
) -> Encoded:
    """Encode one image with its `labels` as JSON, as JPEG of `quality` or as PNG, with all its pixel labels, and its
    record, to which `facts` are added."""
    name = f"{stem(index)}.png"
    silhouettes = np.zeros(drawing.depth.shape, np.uint8)
    for k, layer in enumerate(list(drawing.layers.values())[:MAX_INSTRUMENTS]):
        silhouettes |= layer.mask.astype(np.uint8) << k
    image = f"images/{stem(index)}{'.png' if quality is None else '.jpg'}"
    parts = drawing.parts.numpy()
    planes = {
        "masks": (parts > 0).astype(np.uint8) * 255,
        "soft": (drawing.share / SHARE_PER_COUNT).round().to(torch.uint8).numpy(),
        "ignore": drawing.ignored.numpy().astype(np.uint8) * IGNORED,
        "parts": parts,
        "depth": np.clip(np.round(drawing.depth / DEPTH_MM_PER_COUNT), 0, 65535).astype(np.uint16),
        "silhouettes": silhouettes,
    }
    files = {image: encoded_image(drawing.image, quality)}
    files |= {f"{folder}/{name}": encoded_png(pixels) for folder, pixels in planes.items()}
    camera = drawing.camera
    record = {
        "index": index,
        "image": image,
        "split": split_of(index),
        "width": camera.width,
        "height": camera.height,
        **state_to_json(drawing.state),
        "camera": camera_to_json(to_numpy(camera.world_from_camera)),
        "intrinsics": Lens.of(camera).intrinsics_json(),
        "made_up": round(float(drawing.unobserved.mean()), 4),
        "labels": labels,
        **facts,
        "refused": dict(sorted(refused.items())),
    }
    record["files"] = {file: len(files[file]) for file in files_of(record)}
    return Encoded(record, files)


def skipped_sample(index: int, refused: Mapping[str, int], facts: Mapping[str, Any] = MappingProxyType({})) -> Encoded:
    """Return the record that `index` has no image, and why; `facts` are added."""
    record = {"index": index, "skipped": True, **facts, "refused": dict(sorted(refused.items())), "files": {}}
    return Encoded(record, {})


def _digest(record: Record) -> str:
    return hashlib.sha256(json.dumps(record, sort_keys=True).encode()).hexdigest()


def record_path(root: Path, index: int) -> Path:
    """Return the path of the record of image `index`."""
    return root / RECORDS / f"{stem(index)}.json"


def load_record(root: Path, index: int) -> Record | None:
    """Return the record of image `index` if it is unchanged and all its files exist and are complete, else None.

    Records of older versions that wrote less are incomplete: their images are rendered again.
    """
    try:
        record = json.loads(read_text(record_path(root, index), "the record of an image"))
        if record.pop(CHECKSUM, None) != _digest(record):
            return None
        files = () if record.get("skipped") else files_of(record)
        sizes = {name: (root / name).stat().st_size for name in files}
    except (NeecoError, OSError, ValueError, AttributeError, TypeError, RecursionError):
        return None
    return record if sizes == record.get("files") and record.get("index") == index else None


def link(source: Path, target: Path) -> None:
    """Make `target` the same file as `source`: a hard link, or a copy where the file system has none. Raises
    NeecoError."""
    require_replaceable(target)
    with contextlib.suppress(FileNotFoundError):
        if os.path.samefile(source, target):
            return
        target.unlink()
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        os.link(source, target)
    except OSError:
        write_atomically(target, lambda temporary: temporary.write_bytes(read_bytes(source, "an image")))


def files_of(record: Record) -> list[str]:
    """Return the files of an image, other than its record, relative to the data set."""
    return [record["image"], *(f"{folder}/{stem(record['index'])}.png" for folder in LABELS)]


def write_states(root: Path, records: list[Record]) -> None:
    """Write states.jsonl: a line per image, state and labels; readable again as `--states states.jsonl`."""
    lines = []
    for record in records:
        labels = []
        for label in record["labels"]:
            shapes = {None: label, **label["parts"]}
            without = {name: {k: v for k, v in shape.items() if k not in POLYGONS} for name, shape in shapes.items()}
            labels.append(without.pop(None) | {"parts": without})
        lines.append(json.dumps(public_record(record) | {"labels": labels}, allow_nan=False) + "\n")
    write_text(root / "states.jsonl", "".join(lines))


def public_record(record: Record) -> dict[str, Any]:
    """Return a record without information on its making."""
    return {key: value for key, value in record.items() if key not in ("files", "refused")}


@dataclass(frozen=True, kw_only=True)
class WrittenImages:
    """The images of a data set's folder and their labels, for a `Writer`.

    records: one per image, in the order of their numbers, with the keys of states.jsonl (docs/synthesis.md). Files are
    `root / record["image"]`, and `root / FOLDER / f"{stem(record['index'])}.png"` for the folders of labels.
    """

    root: Path
    records: Sequence[Record]
    part_names: tuple[tuple[str, str], ...]  # (instrument, part) of part id 1, 2, ...
    keypoint_names: tuple[str, ...]
    bones: Sequence[tuple[str, str]]  # pairs of keypoints that a line joins
    scene: GaussianScene  # that rendered the images and labels
    labeller: Labeller

    @property
    def instruments(self) -> tuple[str, ...]:
        """Names of the instruments, in the order of their part ids."""
        return instruments_of(self.part_names)


class Writer(ABC):
    """A data set format. Its class attributes are what the command line and the data set's README.md say of it."""

    format: ClassVar[str]  # name for --formats, and of the folder in the data set that holds all its files
    description: ClassVar[str]  # a line of README.md: which files, for what
    accepts_distortion: ClassVar[bool] = True  # whether it can describe images rendered with the recording's lens

    def refusal(self, parts: Sequence[str]) -> str:
        """Return why the format cannot describe these parts; "" when it can."""
        return ""

    @abstractmethod
    def write(self, images: WrittenImages) -> None:
        """(Re)write all files of the format; the same images give the same bytes. Raises NeecoError."""
