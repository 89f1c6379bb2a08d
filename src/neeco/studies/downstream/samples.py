"""Labelled images for training and test: recorded frames, and data sets of synthetic images."""

from __future__ import annotations

import hashlib
from collections import OrderedDict
from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, Protocol, TypeVar

import cv2
import numpy as np
from scipy.ndimage import find_objects

from neeco.base.errors import NeecoError
from neeco.base.files import read_bytes, read_json, read_json_lines, require_inside, require_like
from neeco.base.settings import name_and_value
from neeco.capture.checks.frames import PARTS_FILE
from neeco.capture.images import image_files, image_size, read_image_bytes, read_labels
from neeco.capture.model import Capture, Frame
from neeco.evaluation.masks import Masks, open_masks, open_truth, pairs_of, truth_file, truth_names

ClassNames = Literal["instrument", "parts"]
WHOLE = ("instrument",)  # classes without parts
DATASET_FILE, STATES_FILE, IMAGE_FOLDER = "dataset.json", "states.jsonl", "images"
ANEW = "synthesize the set again"
V = TypeVar("V")


@dataclass(frozen=True)
class Example:
    """One image with its labels, in pixels."""

    image: np.ndarray  # uint8 [H, W, 3]
    classes: np.ndarray  # uint8 [H, W], 0 tissue, else the class, from 1
    valid: np.ndarray | None = None  # bool [H, W], False where pixels are neither learned nor scored; None: all valid

    @property
    def bytes(self) -> int:
        """Size in memory, bytes."""
        return sum(array.nbytes for array in vars(self).values() if array is not None)

    @property
    def shown(self) -> np.ndarray:
        """The classes [n] int64 in the image."""
        return np.unique(self.classes[self.classes > 0]).astype(np.int64)

    def boxes(self) -> tuple[np.ndarray, np.ndarray]:
        """Return bounding boxes [n, 4] (x0, y0, x1, y1; px, x1 and y1 exclusive) of each class, and the classes [n]."""
        places = [place for place in find_objects(self.classes) if place is not None]
        boxes = [(x.start, y.start, x.stop, y.stop) for y, x in places]
        return np.array(boxes, np.float64).reshape(-1, 4), self.shown

    def outlines(self) -> list[tuple[int, np.ndarray]]:
        """Return each class with the corners [n, 2] (x, y, relative to the image's sides; float32) of its border
        pixels, from which boxes are computed after augmentation."""
        height, width = self.classes.shape
        outlines = []
        for number in self.shown.tolist():
            inside = (self.classes == number).astype(np.uint8)
            rows, columns = np.nonzero(inside - cv2.erode(inside, np.ones((3, 3), np.uint8), borderValue=0))
            corners = np.concatenate([np.stack([columns + x, rows + y], 1) for x in (0, 1) for y in (0, 1)])
            outlines.append((number, corners.astype(np.float32) / np.array([width, height], np.float32)))
        return outlines


def class_names(capture: Capture, classes: ClassNames) -> tuple[str, ...]:
    """Return the classes of a model: the instrument, or the parts of the capture's ground truth. Raises NeecoError."""
    if classes == "instrument":
        return WHOLE
    return tuple(dict.fromkeys(paired_parts(truth_names(capture.root)).values()))


def paired_parts(names: Mapping[int, str]) -> dict[int, str]:
    """Return the part by id, with one name for both parts of a pair: images do not show which jaw is the left one."""
    pairs = {part: pair for pair, both in pairs_of(names.values()).items() for part in both}
    return {number: pairs.get(part, part) for number, part in names.items()}


def class_table(parts: Mapping[int, str], classes: Sequence[str]) -> bytes:
    """Return the class, from 1, of each of the 256 ids of a label image with these parts; 0: none."""
    table = bytearray(256)
    for number, part in paired_parts(parts).items():
        name = WHOLE[0] if classes == WHOLE else part
        table[number] = classes.index(name) + 1 if name in classes else 0
    return bytes(table)


def _classes_of(ids: np.ndarray, table: bytes, file: Path, remedy: str) -> np.ndarray:
    """Return the classes of label ids [H, W]. Raises NeecoError for an id without a class (else learned as tissue)."""
    classes = np.frombuffer(table, np.uint8)[ids]
    unknown = ids[(classes == 0) & (ids > 0)]
    if len(unknown):
        raise NeecoError(f"{file}: id {unknown.min()} has no class; {remedy}")
    return classes


class Sample(Protocol):
    """An image with labels that is read on demand. name: for messages and tables; key: equal for the same content.
    `load` raises NeecoError."""

    @property
    def name(self) -> str: ...
    @property
    def key(self) -> Hashable: ...
    def load(self) -> Example: ...


class Cache:
    """Cache of decoded images by key, of at most `limit` bytes; least recently used ones are evicted."""

    def __init__(self, limit: int = 1 << 30) -> None:
        self.limit, self.used = limit, 0
        self._kept: OrderedDict[Hashable, Any] = OrderedDict()

    def get(self, key: Hashable, make: Callable[[], V]) -> V:
        """Return the value of `key`, computed by `make` if it is not cached; its size is its attribute `bytes`."""
        if key not in self._kept:
            self._kept[key] = make()
            self.used += self._kept[key].bytes
        self._kept.move_to_end(key)
        value: V = self._kept[key]
        while self.used > self.limit and len(self._kept) > 1:
            self.used -= self._kept.popitem(last=False)[1].bytes
        return value

    def load(self, sample: Sample) -> Example:
        """Return the sample's example."""
        return self.get(sample.key, sample.load)


CACHE = Cache()  # of examples


@dataclass(frozen=True)
class RecordedSample:
    """A recorded frame; its labels are the capture's truth or a folder of masks. table: as of `class_table`."""

    frame: Frame
    masks: Masks
    table: bytes

    @property
    def name(self) -> str:
        return self.frame.name

    @property
    def key(self) -> Hashable:
        return self.frame.image_path, self.masks.files[self.name], self.table

    def load(self) -> Example:
        """Raises NeecoError if labels and image differ in size, or an id has no class."""
        ids, file = self.masks.load(self.name), self.masks.files[self.name]
        pixels, mask = self.frame.load_image_bytes().numpy(), self.frame.load_mask()
        if ids.shape != pixels.shape[:2]:
            raise NeecoError(f"{file}: differs in size from its frame; label the frames at recorded size")
        remedy = "correct the mask, or remove its frame"
        return Example(pixels, _classes_of(ids, self.table, file, remedy), None if mask is None else mask.numpy())


@dataclass(frozen=True)
class SyntheticSample:
    """An image of a data set. table: as of `class_table`."""

    image: Path
    labels: Path
    table: bytes

    @property
    def name(self) -> str:
        return self.image.stem

    @property
    def key(self) -> Hashable:
        return self.image, self.labels, self.table

    def load(self) -> Example:
        """Raises NeecoError if labels and image differ in size, or an id has no class."""
        ids = read_labels(self.labels, image_size(self.image)).numpy()
        return Example(read_image_bytes(self.image), _classes_of(ids, self.table, self.labels, ANEW))


def permuted(samples: Sequence[SyntheticSample]) -> tuple[SyntheticSample, ...]:
    """Return the images with labels of other images, by a fixed cyclic permutation in random order."""
    order = np.random.default_rng(0).permutation(len(samples))
    source = dict(zip(order.tolist(), np.roll(order, 1).tolist(), strict=True))
    return tuple(replace(sample, labels=samples[source[index]].labels) for index, sample in enumerate(samples))


@dataclass(frozen=True)
class ImageSet:
    """A folder of synthetic images for training. count: number of images used, None for all."""

    name: str
    path: Path
    count: int | None = None

    @classmethod
    def of(cls, word: str) -> ImageSet:
        """Parse NAME=DATASET or NAME=DATASET:COUNT; an existing folder of the full name has precedence. Raises
        NeecoError."""
        name, place = name_and_value("--sets", word, "kinematic=dataset")
        folder, colon, count = place.rpartition(":")
        if not colon or not count.isdecimal() or Path(place).exists():
            return cls(name, Path(place))
        if int(count) < 1:
            raise NeecoError(f"--sets {word}: the number of images must be at least 1 (got {count})")
        return cls(name, Path(folder), int(count))

    def file(self, *names: str) -> Path:
        """Return the path of a file or folder in the set. Raises NeecoError if a link leaves the set."""
        return require_inside(self.path.joinpath(*names), self.path)

    def info(self) -> Any:
        """Return the contents of its dataset.json; None without one. Raises NeecoError."""
        file = self.file(DATASET_FILE)
        if not file.is_file():
            return None
        info = require_like(read_json(file), {"ids": [{"id": int, "part": str}], "settings": dict}, str(file), ANEW)
        for entry in info["ids"]:
            if not 0 <= entry["id"] < 256:
                raise NeecoError(f"{file}: ids: must be 0 to 255 (got {entry['id']}); {ANEW}")
        return info

    def instruments(self) -> int:
        """Return the number of instruments that its labels distinguish."""
        ids = (self.info() or {"ids": ()})["ids"]
        return len({entry.get("instrument") for entry in ids if entry["id"]})

    def described(self) -> dict[str, Any]:
        """Return its identity; the `sha256` of its dataset.json changes when the set is written again."""
        file = self.file(DATASET_FILE)
        digest = hashlib.sha256(read_bytes(file, "a data set")).hexdigest() if file.is_file() else None
        return {"name": self.name, "path": str(self.path.absolute()), "count": self.count, "sha256": digest}


def recorded_samples(
    capture: Capture, split: str | None, classes: ClassNames, labels: Path | None = None
) -> tuple[RecordedSample, ...]:
    """Return the labelled frames of a split (None: all), with the capture's ground truth or a folder of masks named as
    the frames. Raises NeecoError if there is none, or if parts are requested and the labels have none."""
    masks = None if labels is None else open_masks(labels, option=f"{labels / PARTS_FILE}:")
    chosen = capture.frames if split is None else capture.split(split)
    if masks is None and any(truth_file(capture.root, frame.name) for frame in chosen):
        masks = open_truth(capture, splits=None if split is None else [split])
    frames = [] if masks is None else [frame for frame in chosen if frame.name in masks.files]
    if masks is None or not frames:
        place = f"{capture.root}: {split or 'all frames'}" if labels is None else f"--labels {labels}"
        raise NeecoError(f"{place}: no frame has a label; give --labels FOLDER with masks named as the frames")
    class_list = class_names(capture, classes)
    if classes == "parts" and not set(paired_parts(masks.names or {}).values()) & set(class_list):
        raise NeecoError(f"--classes parts: the labels in {masks.path} have no parts; use --classes instrument")
    # if only some frames' ground truth has parts, every id belongs to the instrument
    table = class_table(masks.names or dict.fromkeys(range(1, 256), WHOLE[0]), class_list)
    return tuple(RecordedSample(frame, masks, table) for frame in frames)


def frame_size(samples: Sequence[RecordedSample]) -> tuple[int, int]:
    """Return (width, height) of recorded frames. Raises NeecoError if they differ."""
    sizes = {(sample.frame.camera.width, sample.frame.camera.height) for sample in samples}
    if len(sizes) > 1:
        raise NeecoError(f"{samples[0].frame.image_path.parent}: frames differ in size; use captures of one size")
    return next(iter(sizes))


def synthetic_samples(data: ImageSet, classes: Sequence[str], size: tuple[int, int]) -> tuple[SyntheticSample, ...]:
    """Return the first `count` images of a data set with their labels. Of a set written by `neeco annotate` only the
    frames of split train are used. size: required (width, height). Raises NeecoError."""
    folder, info = data.file(IMAGE_FOLDER), data.info()
    images = image_files(folder) if folder.is_dir() else ()
    if info is not None and "annotates" in info["settings"]:
        like = {"image": str, "recorded_split": str}
        rows = read_json_lines(data.file(STATES_FILE), like, "a line per image", "annotate it again")
        learned = {Path(row["image"]).name for row in rows if row["recorded_split"] == "train"}
        images = tuple(image for image in images if image.name in learned)
    if len(images) < (data.count or 1):
        required = "at least one" if data.count is None else str(data.count)
        problem = f"{folder}: has {len(images)} training images, expected {required}; give a `neeco synthesize` output"
        raise NeecoError(f"--sets {data.name}: {problem}")
    table = class_table({1: WHOLE[0], 255: WHOLE[0]}, classes)  # 255: black and white masks
    if info is not None:
        table = class_table({entry["id"]: entry["part"] for entry in info["ids"] if entry["id"]}, classes)
    if not any(table):
        parts = ", ".join(classes)
        raise NeecoError(f"--sets {data.name}: {data.path}: no label of {parts}; use --classes instrument")
    samples = []
    for image in images[: data.count]:
        labels = data.file("masks" if info is None else "parts", f"{image.stem}.png")
        if not labels.is_file():
            raise NeecoError(f"--sets {data.name}: {labels}: no such file; every image needs labels")
        if image_size(require_inside(image, data.path)) != size:
            expected = f"{size[0]}x{size[1]}, as the capture's frames"
            raise NeecoError(
                f"--sets {data.name}: {image}: is not {expected}; synthesize it from a run of this capture"
            )
        samples.append(SyntheticSample(image, labels, table))
    samples[0].load()  # raises early if its ids have no class
    return tuple(samples)
