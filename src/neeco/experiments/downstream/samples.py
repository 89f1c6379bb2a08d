"""Labelled images to learn from and to be tested on: recorded frames, and data sets of drawn images."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, Protocol

import numpy as np

from neeco.capture.images import EXTENSIONS, image_size, open_image, read_image, read_labels
from neeco.capture.model import Capture, Frame
from neeco.errors import NeecoError
from neeco.evaluation.mask_folders import PARTS_FILE, Masks, open_masks, open_truth, truth_file
from neeco.evaluation.mask_metrics import TRUTH_PARTS
from neeco.files import read_json, read_text, require_inside

ClassNames = Literal["instrument", "parts"]
Edges = Literal["hard", "soft", "ignore"]
CLASSES: Mapping[str, tuple[str, ...]] = {"instrument": ("instrument",), "parts": ("shaft", "wrist", "jaws")}
JAWS = ("jaw_left", "jaw_right")  # one class: which of them is left is a name that images do not show
INFO = "dataset.json"
STATES = "states.jsonl"
DRAWN_IN = "images"
MASK = 255  # an id that means instrument and nothing more, as in black and white masks


@dataclass(frozen=True)
class Example:
    """One image with its labels, in pixels."""

    image: np.ndarray  # uint8 [H, W, 3]
    classes: np.ndarray  # uint8 [H, W], 0 tissue, else number of the class, from 1
    instruments: np.ndarray  # uint8 [H, W], 0 tissue, else number of the instrument, from 1
    counted: np.ndarray | None = None  # bool [H, W], False where nothing may be learned or judged; None: all count
    share: np.ndarray | None = None  # float32 [H, W], how much of a pixel is instrument; None: all or nothing

    def boxes(self) -> tuple[np.ndarray, np.ndarray]:
        """[n, 4] (x0, y0, x1, y1; px, x1 and y1 exclusive) about each class of each instrument, and the classes [n]."""
        codes = self.instruments.astype(np.int64) * 256 + self.classes
        boxes, classes = [], []
        for code in np.unique(codes[self.classes > 0]):
            rows, columns = np.nonzero(codes == code)
            boxes.append((columns.min(), rows.min(), columns.max() + 1, rows.max() + 1))
            classes.append(code % 256)
        return np.array(boxes, np.float64).reshape(-1, 4), np.array(classes, np.int64)


class Sample(Protocol):
    """Where one example lies."""

    @property
    def name(self) -> str:
        """What the image is called."""
        ...

    def load(self) -> Example:
        """Read it. Raises NeecoError."""
        ...


@dataclass(frozen=True)
class Meaning:
    """What the ids of label images mean: the number of the class and of the instrument, uint8 [256] each."""

    classes: np.ndarray
    instruments: np.ndarray

    def check(self, ids: np.ndarray, file: Path, remedy: str) -> None:
        """Raises NeecoError where one of `ids` (uint8) belongs to no class: it would be taught as tissue."""
        strange = (self.classes[ids] == 0) & (ids > 0)
        if strange.any():
            raise NeecoError(f"{file}: id {ids[strange].min()} means nothing; {remedy}")


@dataclass(frozen=True)
class RecordedSample:
    """A recorded frame; its labels are the truth's, or somebody's."""

    frame: Frame
    masks: Masks
    meaning: Meaning

    @property
    def name(self) -> str:
        return self.frame.name

    def load(self) -> Example:
        """Raises NeecoError where the labels are of another size than the image, or have an id that means nothing."""
        ids = self.masks.load(self.name)
        self.meaning.check(ids, self.masks.files[self.name], "mend the mask, or leave its frame out")
        pixels = (self.frame.load_image().numpy() * 255).round().astype(np.uint8)
        counted = self.frame.load_mask()
        if ids.shape != pixels.shape[:2]:
            raise NeecoError(
                f"{self.masks.files[self.name]}: is {ids.shape[1]}x{ids.shape[0]}, its frame is "
                f"{pixels.shape[1]}x{pixels.shape[0]}; label the frames as recorded"
            )
        return Example(
            pixels,
            self.meaning.classes[ids],
            self.meaning.instruments[ids],
            None if counted is None else counted.numpy(),
        )

    def part_pixels(self, parts: Collection[str]) -> np.ndarray | None:
        """bool [H, W]: the pixels of these parts; None where the labels tell no parts. Raises NeecoError."""
        names = self.masks.names
        if names is None:
            return None
        return np.isin(self.masks.load(self.name), [number for number, part in names.items() if part in parts])


@dataclass(frozen=True)
class DrawnSample:
    """An image of a data set. `soft`, `ignore`: read where they are to be used."""

    image: Path
    labels: Path
    meaning: Meaning
    soft: Path | None = None
    ignore: Path | None = None

    @property
    def name(self) -> str:
        return self.image.stem

    def load(self) -> Example:
        """Raises NeecoError where a file is of another size, or has an id that means nothing."""
        size = image_size(self.image)
        ids = read_labels(self.labels, size).numpy()
        self.meaning.check(ids, self.labels, f"name it in {INFO}, or draw the set again")
        pixels = (read_image(self.image).numpy() * 255).round().astype(np.uint8)
        counted = None if self.ignore is None else _grey(self.ignore, size) < 128
        share = None if self.soft is None else _grey(self.soft, size).astype(np.float32) / 255
        return Example(pixels, self.meaning.classes[ids], self.meaning.instruments[ids], counted, share)


@dataclass(frozen=True)
class DataSet:
    """A folder of drawn images to learn from. `count`: use so many of them, None for all."""

    name: str
    path: Path
    count: int | None = None

    def file(self, *names: str) -> Path:
        """A file or folder of it. Raises NeecoError where a link leads out of it."""
        return require_inside(self.path.joinpath(*names), self.path)

    def info(self) -> Any:
        """What its dataset.json says, fit to be written into another file; None where there is none. Raises
        NeecoError."""
        file = self.file(INFO)
        if not file.is_file():
            return None
        stated = read_json(file)
        try:
            json.dumps(stated, allow_nan=False)
        except (ValueError, RecursionError):
            raise NeecoError(
                f"--sets {self.name}: {file}: holds NaN or an infinite number; draw the set again"
            ) from None
        return stated

    def described(self) -> dict[str, Any]:
        """What tells it from others, for a file; `sha256` of its description changes when it is drawn anew."""
        file = self.file(INFO)
        digest = hashlib.sha256(file.read_bytes()).hexdigest() if file.is_file() else None
        return {"name": self.name, "path": str(self.path.absolute()), "count": self.count, "sha256": digest}


def recorded_samples(
    capture: Capture, split: str, classes: ClassNames, labels: Path | None = None
) -> tuple[RecordedSample, ...]:
    """The labelled frames of a split: by the capture's truth, or by a folder of masks named as the frames.

    Frames without a label are left out. Raises NeecoError where there is none at all, or parts are asked for and the
    labels tell none.
    """
    masks = None if labels is None else open_masks(labels, option=f"{labels / PARTS_FILE}:")
    if masks is None and any(truth_file(capture.root, frame.name) for frame in capture.split(split)):
        masks = _truth(capture, split)
    frames = [] if masks is None else [frame for frame in capture.split(split) if frame.name in masks.files]
    if masks is None or not frames:
        where = f"{capture.root}: split {split}" if labels is None else f"--labels {labels}"
        raise NeecoError(f"{where}: no frame has a label; give --labels FOLDER with masks named as the frames")
    if classes == "parts" and not set((masks.names or {}).values()) & set(TRUTH_PARTS):
        raise NeecoError(f"--classes parts: the labels in {masks.path} tell no parts; use --classes instrument")
    # where some frames' truth has parts and others' has none, every id is a piece of the instrument
    named = dict.fromkeys(range(1, 256), "instrument") if masks.names is None else masks.names
    meaning = _meaning({number: (1, part) for number, part in named.items()}, classes)
    return tuple(RecordedSample(frame, masks, meaning) for frame in frames)


def has_labels(capture: Capture, split: str) -> bool:
    """Whether any frame of the split has a true mask."""
    try:
        return bool(_truth(capture, split).files)
    except NeecoError:
        return False


def drawn_samples(data: DataSet, classes: ClassNames, edges: Edges, size: tuple[int, int]) -> tuple[DrawnSample, ...]:
    """The images of a data set in their order, each with its labels; the first `count` of them.

    A set that `neeco synthesize` wrote says what its ids mean; of another's, masks/ tell instrument from tissue. Of one
    that `neeco annotate` wrote only the frames of split train are learned from: models are tested on the others. size:
    (width, height) that they must have. Raises NeecoError.
    """
    folder = data.file(DRAWN_IN)
    if not folder.is_dir():
        raise NeecoError(f"--sets {data.name}: {data.path}: no folder {DRAWN_IN}/; give what `neeco synthesize` wrote")
    images = [file for file in sorted(folder.iterdir()) if file.suffix in EXTENSIONS and not file.name.startswith(".")]
    if not images:
        raise NeecoError(f"--sets {data.name}: {folder}: has no image; give what `neeco synthesize` wrote")
    images = _not_tested_on(data, images)
    if data.count is not None and data.count > len(images):
        raise NeecoError(f"--sets {data.name}: {data.path}: has {len(images)} images, not {data.count}; draw more")
    labels, meaning = _labels_of(data, classes)
    samples = [DrawnSample(image, data.file(labels, f"{image.stem}.png"), meaning) for image in images[: data.count]]
    for sample in samples:
        require_inside(sample.image, data.path)
        if not sample.labels.is_file():
            raise NeecoError(f"--sets {data.name}: {sample.labels}: no such file; every image needs its labels")
        found = image_size(sample.image)
        if found != size:
            raise NeecoError(
                f"--sets {data.name}: {sample.image} is {found[0]}x{found[1]}, the capture's frames are "
                f"{size[0]}x{size[1]}; draw it from a run of this capture"
            )
    samples[0].load()  # whether its ids mean anything is known before the work
    return tuple(_with_edges(sample, data, edges) for sample in samples)


def _not_tested_on(data: DataSet, images: list[Path]) -> list[Path]:
    """The images that are drawn, or recorded frames of split train."""
    stated, states = data.info(), data.file(STATES)
    settings = stated.get("settings") if isinstance(stated, dict) else None
    if not isinstance(settings, dict) or "annotates" not in settings:
        return images
    text = read_text(states, "what `neeco annotate` says of every frame")
    try:
        lines = [json.loads(line) for line in text.splitlines()]
        splits = {Path(line["image"]).name: line["recorded_split"] for line in lines}
        kept = [image for image in images if splits[image.name] == "train"]
    except (ValueError, TypeError, LookupError, RecursionError):
        raise NeecoError(f"--sets {data.name}: {states}: not as `neeco annotate` writes it") from None
    if not kept:
        raise NeecoError(f"--sets {data.name}: {data.path}: none of its frames is of split train; annotate more")
    return kept


def _with_edges(sample: DrawnSample, data: DataSet, edges: Edges) -> DrawnSample:
    """The sample with the file that says how its edges are to be learned."""
    if edges == "hard":
        return sample
    file = data.file(edges, f"{sample.name}.png")
    if not file.is_file():
        raise NeecoError(f"--sets {data.name}: {file}: no such file; draw the set again, or use {data.name}+hard")
    return replace(sample, soft=file) if edges == "soft" else replace(sample, ignore=file)


def _labels_of(data: DataSet, classes: ClassNames) -> tuple[str, Meaning]:
    """In which folder of a data set its labels are, and what they mean."""
    file, stated = data.file(INFO), data.info()
    if stated is None:
        if classes == "parts":
            raise NeecoError(
                f"--sets {data.name}: {file}: no such file, so no parts are known; use --classes instrument"
            )
        return "masks", _meaning({number: (1, "instrument") for number in (1, MASK)}, classes)
    try:
        entries = [(int(entry["id"]), str(entry["instrument"]), str(entry["part"])) for entry in stated["ids"][1:]]
        if not all(0 < number < 256 for number, _, _ in entries):
            raise ValueError
    except (KeyError, TypeError, ValueError, IndexError):
        raise NeecoError(f"--sets {data.name}: {file}: ids: not as `neeco synthesize` writes them") from None
    instruments = list(dict.fromkeys(instrument for _, instrument, _ in entries))
    parts = {number: (instruments.index(instrument) + 1, part) for number, instrument, part in entries}
    if classes == "parts" and not {part for _, part in parts.values()} & set(TRUTH_PARTS):
        raise NeecoError(f"--sets {data.name}: {data.path}: its labels tell no parts; use --classes instrument")
    return "parts", _meaning(parts, classes)


def _meaning(parts: Mapping[int, tuple[int, str]], classes: ClassNames) -> Meaning:
    """From (number of the instrument, part) by id."""
    class_of, instrument_of = np.zeros(256, np.uint8), np.zeros(256, np.uint8)
    for number, (instrument, part) in parts.items():
        name = "instrument" if classes == "instrument" else "jaws" if part in JAWS else part
        names = CLASSES[classes]
        class_of[number] = names.index(name) + 1 if name in names else 0
        instrument_of[number] = instrument
    return Meaning(class_of, instrument_of)


def _truth(capture: Capture, split: str) -> Masks:
    return open_truth(capture, splits=[split])


def _grey(file: Path, size: tuple[int, int]) -> np.ndarray:
    """uint8 [H, W] of an 8-bit grey image."""
    return np.asarray(open_image(file, size).convert("L"))


def frame_size(samples: Sequence[RecordedSample]) -> tuple[int, int]:
    """(width, height) of recorded frames. Raises NeecoError where they differ."""
    sizes = {(sample.frame.camera.width, sample.frame.camera.height) for sample in samples}
    if len(sizes) > 1:
        raise NeecoError(f"{samples[0].frame.image_path.parent}: frames of several sizes; make captures of one size")
    return next(iter(sizes))
