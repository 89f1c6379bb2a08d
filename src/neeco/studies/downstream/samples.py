"""Labelled images to train on and to test on: recorded frames, and data sets of synthetic images."""

from __future__ import annotations

import hashlib
import json
from collections import OrderedDict
from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Generic, Literal, Protocol, TypeVar

import cv2
import numpy as np

from neeco.capture.checks.truth import PARTS_FILE
from neeco.capture.images import image_files, image_size, read_image_bytes, read_labels
from neeco.capture.model import Capture, Frame
from neeco.errors import NeecoError
from neeco.evaluation.mask_folders import Masks, open_masks, open_truth, truth_file, truth_names
from neeco.evaluation.mask_metrics import pairs_of
from neeco.files import read_bytes, read_json, read_text, require_inside

ClassNames = Literal["instrument", "parts"]
WHOLE = ("instrument",)  # the classes where an instrument is one
CACHE_BYTES = 1 << 30  # of decoded images of one kind that a process keeps
DATASET_FILE, STATES_FILE, IMAGE_FOLDER = "dataset.json", "states.jsonl", "images"


K = TypeVar("K", bound=Hashable)
V = TypeVar("V")


class LeastRecentlyUsed(Generic[K, V]):
    """Values by key, of at most `limit` bytes in all; those that were not used for longest go first."""

    def __init__(self, limit: int = CACHE_BYTES) -> None:
        self.limit, self.used = limit, 0
        self._kept: OrderedDict[K, tuple[V, int]] = OrderedDict()

    def get(self, key: K, make: Callable[[], V], size: Callable[[V], int]) -> V:
        """The value of `key`, made where it is not kept. size: of a value, in bytes."""
        if key in self._kept:
            self._kept.move_to_end(key)
            return self._kept[key][0]
        value = make()
        self._kept[key] = value, size(value)
        self.used += self._kept[key][1]
        while self.used > self.limit and len(self._kept) > 1:
            self.used -= self._kept.popitem(last=False)[1][1]
        return value


@dataclass(frozen=True)
class Example:
    """One image with its labels, in pixels."""

    image: np.ndarray  # uint8 [H, W, 3]
    classes: np.ndarray  # uint8 [H, W], 0 tissue, else the class, from 1
    instruments: np.ndarray  # uint8 [H, W], 0 tissue, else the instrument, from 1
    valid: np.ndarray | None = None  # bool [H, W], False where pixels are neither learned nor scored; None: all valid

    @property
    def bytes(self) -> int:
        """Its size in memory."""
        return sum(array.nbytes for array in vars(self).values() if array is not None)

    def boxes(self) -> tuple[np.ndarray, np.ndarray]:
        """[n, 4] (x0, y0, x1, y1; px, x1 and y1 exclusive) about each class of each instrument, and the classes [n]."""
        codes = self.instruments.astype(np.int64) * 256 + self.classes
        boxes, classes = [], []
        for code in np.unique(codes[self.classes > 0]):
            rows, columns = np.nonzero(codes == code)
            boxes.append((columns.min(), rows.min(), columns.max() + 1, rows.max() + 1))
            classes.append(code % 256)
        return np.array(boxes, np.float64).reshape(-1, 4), np.array(classes, np.int64)

    def outlines(self) -> list[tuple[int, np.ndarray]]:
        """Each class of each instrument with the corners [n, 2] (x, y, shares of the image's sides; float32) of the
        pixels at its border: what a box is about, wherever the image is moved."""
        height, width = self.classes.shape
        codes = self.instruments.astype(np.int64) * 256 + self.classes
        found = []
        for code in np.unique(codes[self.classes > 0]):
            inside = (codes == code).astype(np.uint8)
            rows, columns = np.nonzero(inside - cv2.erode(inside, np.ones((3, 3), np.uint8), borderValue=0))
            corners = [np.stack([columns + x, rows + y], 1) for x in (0, 1) for y in (0, 1)]
            found.append(
                (int(code % 256), np.concatenate(corners).astype(np.float32) / np.array([width, height], np.float32))
            )
        return found

    def relative_boxes(self) -> tuple[np.ndarray, np.ndarray]:
        """`boxes` as [n, 4] centre x, y, width, height, shares of the image's sides; and the classes [n]."""
        boxes, classes = self.boxes()
        height, width = self.classes.shape
        centres, sizes = (boxes[:, :2] + boxes[:, 2:]) / 2, boxes[:, 2:] - boxes[:, :2]
        return np.concatenate([centres, sizes], 1) / np.array([width, height, width, height], np.float64), classes


def class_names(capture: Capture, classes: ClassNames) -> tuple[str, ...]:
    """Return the classes of a model: the instrument, or the parts of the capture's truth. Raises NeecoError."""
    if classes == "instrument":
        return WHOLE
    return tuple(dict.fromkeys(_paired(truth_names(capture.root)).values()))


def _paired(names: Mapping[int, str]) -> dict[int, str]:
    """Part by id, with one name for both of a pair: an image does not show which jaw is called left."""
    pairs = {part: pair for pair, both in pairs_of(names.values()).items() for part in both}
    return {number: pairs.get(part, part) for number, part in names.items()}


class LabelMap:
    """Class and instrument of every id in label images, uint8 [256] each, from {id: (instrument, from 1; part)};
    classes: as `class_names` gives them."""

    def __init__(self, parts: Mapping[int, tuple[int, str]], classes: Sequence[str]) -> None:
        self.classes, self.instruments = np.zeros((2, 256), np.uint8)
        paired = _paired({number: part for number, (_, part) in parts.items()})
        for number, (instrument, _) in parts.items():
            name = WHOLE[0] if classes == WHOLE else paired[number]
            self.classes[number] = classes.index(name) + 1 if name in classes else 0
            self.instruments[number] = instrument

    @property
    def key(self) -> Hashable:
        """Equal for maps that are."""
        return self.classes.tobytes(), self.instruments.tobytes()

    def check(self, ids: np.ndarray, file: Path, remedy: str) -> None:
        """Raises NeecoError where one of `ids` (uint8) has no class: it would be learned as tissue."""
        unknown = (self.classes[ids] == 0) & (ids > 0)
        if unknown.any():
            raise NeecoError(f"{file}: id {ids[unknown].min()} has no class; {remedy}")


class Sample(Protocol):
    """An image with labels that is read when it is needed."""

    @property
    def name(self) -> str:
        """Its name in messages and tables."""

    @property
    def key(self) -> Hashable:
        """Equal for samples that load the same."""

    def load(self) -> Example:
        """Read it. Raises NeecoError."""


EXAMPLES: LeastRecentlyUsed[Hashable, Example] = LeastRecentlyUsed()


def loaded(sample: Sample) -> Example:
    """The sample's example, kept for as long as there is room."""
    return EXAMPLES.get(sample.key, sample.load, lambda example: example.bytes)


@dataclass(frozen=True)
class RecordedSample:
    """A recorded frame; its labels are the capture's truth or a folder of masks."""

    frame: Frame
    masks: Masks
    label_map: LabelMap

    @property
    def name(self) -> str:
        return self.frame.name

    @property
    def key(self) -> Hashable:
        return self.frame.image_path, self.masks.files[self.name], self.label_map.key

    def load(self) -> Example:
        """Raises NeecoError where the labels differ from the image in size, or have an id without a class."""
        ids, file = self.masks.load(self.name), self.masks.files[self.name]
        self.label_map.check(ids, file, "correct the mask, or leave its frame out")
        pixels = self.frame.load_image_bytes().numpy()
        valid = self.frame.load_mask()
        if ids.shape != pixels.shape[:2]:
            raise NeecoError(
                f"{file}: is {ids.shape[1]}x{ids.shape[0]}, its frame is {pixels.shape[1]}x{pixels.shape[0]}; "
                "label the frames as recorded"
            )
        labels = self.label_map.classes[ids], self.label_map.instruments[ids]
        return Example(pixels, *labels, None if valid is None else valid.numpy())

    def pairs(self) -> dict[str, np.ndarray]:
        """bool [H, W] by pair: the pixels of its parts; none where the labels have no parts. Raises NeecoError."""
        names = self.masks.names or {}
        ids = self.masks.load(self.name)
        return {
            pair: np.isin(ids, [number for number, part in names.items() if part in both])
            for pair, both in pairs_of(names.values()).items()
        }


@dataclass(frozen=True)
class SyntheticSample:
    """An image of a data set."""

    image: Path
    labels: Path
    label_map: LabelMap

    @property
    def name(self) -> str:
        return self.image.stem

    @property
    def key(self) -> Hashable:
        return self.image, self.labels, self.label_map.key

    def load(self) -> Example:
        """Raises NeecoError where a file is of another size, or has an id without a class."""
        size = image_size(self.image)
        ids = read_labels(self.labels, size).numpy()
        self.label_map.check(ids, self.labels, f"name it in {DATASET_FILE}, or synthesize the set again")
        pixels = read_image_bytes(self.image).numpy()
        return Example(pixels, self.label_map.classes[ids], self.label_map.instruments[ids])


def permuted(samples: Sequence[SyntheticSample]) -> tuple[SyntheticSample, ...]:
    """The same images, each with the labels of another, by a fixed cyclic permutation in random order."""
    order = np.random.default_rng(0).permutation(len(samples))
    source = dict(zip(order.tolist(), np.roll(order, 1).tolist(), strict=True))
    others = [samples[source[index]] for index in range(len(samples))]
    return tuple(replace(sample, labels=other.labels) for sample, other in zip(samples, others, strict=True))


@dataclass(frozen=True)
class ImageSet:
    """A folder of synthetic images to train on. `count`: use so many of them, None for all."""

    name: str
    path: Path
    count: int | None = None

    def __str__(self) -> str:
        """Return the word of the command line."""
        return f"{self.name}={self.path.absolute()}" + ("" if self.count is None else f":{self.count}")

    def file(self, *names: str) -> Path:
        """A file or folder of it. Raises NeecoError where a link leads out of it."""
        return require_inside(self.path.joinpath(*names), self.path)

    def info(self) -> Any:
        """Return the contents of its dataset.json, fit for another JSON file; None without one. Raises NeecoError."""
        file = self.file(DATASET_FILE)
        if not file.is_file():
            return None
        info = read_json(file)
        try:
            json.dumps(info, allow_nan=False)
        except (ValueError, RecursionError):
            raise self.error(f"{file}: holds NaN or an infinite number; synthesize the set again") from None
        return info

    def described(self) -> dict[str, Any]:
        """Return its identity; `sha256` of its dataset.json changes when it is synthesized anew."""
        file = self.file(DATASET_FILE)
        digest = hashlib.sha256(read_bytes(file, "a data set")).hexdigest() if file.is_file() else None
        return {"name": self.name, "path": str(self.path.absolute()), "count": self.count, "sha256": digest}

    def error(self, problem: str) -> NeecoError:
        """The error that names this set."""
        return NeecoError(f"--sets {self.name}: {problem}")


@dataclass(frozen=True)
class OtherCapture:
    """Another recording whose frames with truth a model is tested on, all together."""

    name: str
    path: Path

    def __str__(self) -> str:
        """Return the word of the command line."""
        return f"{self.name}={self.path.absolute()}"


def recorded_samples(
    capture: Capture, split: str | None, classes: ClassNames, labels: Path | None = None
) -> tuple[RecordedSample, ...]:
    """The labelled frames of a split (None: of all): by the capture's truth, or by a folder of masks named as the
    frames.

    Frames without a label are left out. Raises NeecoError where there is none at all, or where parts are requested and
    the labels have none.
    """
    masks = None if labels is None else open_masks(labels, option=f"{labels / PARTS_FILE}:")
    chosen = capture.frames if split is None else capture.split(split)
    if masks is None and any(truth_file(capture.root, frame.name) for frame in chosen):
        masks = open_truth(capture, splits=None if split is None else [split])
    frames = [] if masks is None else [frame for frame in chosen if frame.name in masks.files]
    if masks is None or not frames:
        where = (
            f"{capture.root}: {'all frames' if split is None else f'split {split}'}"
            if labels is None
            else f"--labels {labels}"
        )
        raise NeecoError(f"{where}: no frame has a label; give --labels FOLDER with masks named as the frames")
    wanted = class_names(capture, classes)
    if classes == "parts" and not set(_paired(masks.names or {}).values()) & set(wanted):
        raise NeecoError(f"--classes parts: the labels in {masks.path} have no parts; use --classes instrument")
    # where only some frames' truth has parts, every id is a piece of the instrument
    names = dict.fromkeys(range(1, 256), "instrument") if masks.names is None else masks.names
    label_map = LabelMap({number: (1, part) for number, part in names.items()}, wanted)
    return tuple(RecordedSample(frame, masks, label_map) for frame in frames)


def has_labels(capture: Capture, split: str) -> bool:
    """Return whether any frame of the split has a true mask."""
    try:
        return bool(open_truth(capture, splits=[split]).files)
    except NeecoError:
        return False


def frame_size(samples: Sequence[RecordedSample]) -> tuple[int, int]:
    """(width, height) of recorded frames. Raises NeecoError where they differ."""
    sizes = {(sample.frame.camera.width, sample.frame.camera.height) for sample in samples}
    if len(sizes) > 1:
        raise NeecoError(f"{samples[0].frame.image_path.parent}: frames of several sizes; make captures of one size")
    return next(iter(sizes))


def synthetic_samples(data: ImageSet, classes: Sequence[str], size: tuple[int, int]) -> tuple[SyntheticSample, ...]:
    """The images of a data set in their order, each with its labels; the first `count` of them.

    The dataset.json of `neeco synthesize` says what ids mean; without it, masks/ separate instrument and tissue. Of a
    set that `neeco annotate` wrote only the frames of split train are used: models are tested on the others. size:
    (width, height) that all must have. Raises NeecoError.
    """
    folder = data.file(IMAGE_FOLDER)
    if not folder.is_dir():
        raise data.error(f"{data.path}: no folder {IMAGE_FOLDER}/; give what `neeco synthesize` wrote")
    images = list(image_files(folder))
    if not images:
        raise data.error(f"{folder}: has no image; give what `neeco synthesize` wrote")
    images = _training_images(data, images)
    if data.count is not None and data.count > len(images):
        raise data.error(f"{data.path}: has {len(images)} images, not {data.count}; synthesize more")
    labels, label_map = _labels_of(data, classes)
    samples = []
    for image in images[: data.count]:
        require_inside(image, data.path)
        file = data.file(labels, f"{image.stem}.png")
        if not file.is_file():
            raise data.error(f"{file}: no such file; every image needs its labels")
        found = image_size(image)
        if found != size:
            raise data.error(
                f"{image} is {found[0]}x{found[1]}, the capture's frames are {size[0]}x{size[1]}; synthesize it from "
                "a run of this capture"
            )
        samples.append(SyntheticSample(image, file, label_map))
    samples[0].load()  # raises before the work where its ids have no class
    return tuple(samples)


def _training_images(data: ImageSet, images: list[Path]) -> list[Path]:
    """The images that are synthetic, or recorded frames of split train."""
    info, states = data.info(), data.file(STATES_FILE)
    settings = info.get("settings") if isinstance(info, dict) else None
    if not isinstance(settings, dict) or "annotates" not in settings:
        return images
    text = read_text(states, "what `neeco annotate` says of every frame")
    try:
        lines = [json.loads(line) for line in text.splitlines()]
        splits = {Path(line["image"]).name: line["recorded_split"] for line in lines}
        chosen = [image for image in images if splits[image.name] == "train"]
    except (ValueError, TypeError, LookupError, RecursionError):
        raise data.error(f"{states}: not as `neeco annotate` writes it") from None
    if not chosen:
        raise data.error(f"{data.path}: none of its frames is of split train; annotate more")
    return chosen


def _labels_of(data: ImageSet, classes: Sequence[str]) -> tuple[str, LabelMap]:
    """The folder of a data set that holds its labels, and what they mean."""
    file, info = data.file(DATASET_FILE), data.info()
    if info is None:
        if classes != WHOLE:
            raise data.error(f"{file}: no such file, so no parts are known; use --classes instrument")
        return "masks", LabelMap(dict.fromkeys((1, 255), (1, "instrument")), classes)  # 255: black and white masks
    try:
        entries = [(int(entry["id"]), str(entry["instrument"]), str(entry["part"])) for entry in info["ids"][1:]]
        if not all(0 < number < 256 for number, _, _ in entries):
            raise ValueError
    except (KeyError, TypeError, ValueError, IndexError):
        raise data.error(f"{file}: ids: not as `neeco synthesize` writes them") from None
    instruments = list(dict.fromkeys(instrument for _, instrument, _ in entries))
    parts = {number: (instruments.index(instrument) + 1, part) for number, instrument, part in entries}
    label_map = LabelMap(parts, classes)
    if not label_map.classes.any():
        raise data.error(
            f"{data.path}: its labels have none of the parts {', '.join(classes)}; use --classes instrument"
        )
    return "parts", label_map
