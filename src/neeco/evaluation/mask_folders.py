"""Masks to compare: a capture's truth or reference masks, and any folders of masks; scores of such folders against the
truth: overlap and contours, per instrument and part.

For evaluation only: nothing that learns may read a capture's truth.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from torch import Tensor

from neeco import __version__
from neeco.base.errors import NeecoError
from neeco.base.files import finite, require_inside, visible_entries
from neeco.capture.checks.frames import MASK_FOLDERS, REFERENCE_FOLDER, USUAL_NAMES, stated_names
from neeco.capture.images import open_image, read_labels, read_mask
from neeco.capture.model import Capture, Frame
from neeco.capture.readers import read_capture
from neeco.evaluation.mask_metrics import PartTally, boundary_f, dice, iou, mean_of, pairs_of, part_scores, truth_table

PARTS_SUFFIX, MASK_SUFFIX = "_parts", "_mask"  # of files that `neeco render` writes


@dataclass(frozen=True)
class ReferenceMask:
    """The instrument's true mask, and its parts where they are known."""

    mask: Tensor  # [H, W] bool
    parts: Tensor | None  # [H, W] uint8, the truth's numbers


def truth_file(root: Path, name: str) -> Path | None:
    """Return the true mask of the frame called `name` of the capture in `root`; None when it has none. Raises
    NeecoError where a link leads out of the capture."""
    file = next((file for folder in MASK_FOLDERS if (file := root / folder / f"{name}.png").is_file()), None)
    return None if file is None else require_inside(file, root)


def truth_names(root: Path) -> Mapping[int, str]:
    """Return parts by id in the truth of the capture in `root`, as its parts.json states, else the usual ones. Raises
    NeecoError."""
    return stated_names(root / MASK_FOLDERS[0]) or USUAL_NAMES


def load_reference(capture: Capture, frame: Frame) -> ReferenceMask | None:
    """Return the true mask of a frame: `truth/masks/<stem>.png` (parts), else `reference_masks/<stem>.png` (0/255).

    None when the capture has neither. Raises NeecoError when the file is damaged or of another size than the frame.
    """
    file, size = truth_file(capture.root, frame.name), (frame.camera.width, frame.camera.height)
    if file is None:
        return None
    if file.parent.name == REFERENCE_FOLDER:
        return ReferenceMask(read_mask(file, size), None)
    parts = read_labels(file, size)  # 0 tissue; `truth_names`
    return ReferenceMask(parts > 0, parts)


@dataclass(frozen=True)
class Masks:
    """Masks of images by name. `names`: part by id, or None where the masks tell instrument from tissue only."""

    path: Path
    files: Mapping[str, Path]
    names: Mapping[int, str] | None
    notes: tuple[str, ...] = ()
    capture: Capture | None = None  # whose truth they are
    frames: Mapping[str, Frame] = field(default_factory=dict)  # of the capture: whose pixels may be ignored

    def load(self, name: str) -> np.ndarray:
        """Return the ids [H, W] uint8 of the image of that name; 0 is tissue. Raises NeecoError."""
        reference = load_reference(self.capture, self.frames[name]) if self.capture is not None else None
        if reference is None:
            return read_ids(self.files[name])
        return (reference.mask if reference.parts is None else reference.parts).numpy().astype(np.uint8)

    def counted(self, name: str) -> np.ndarray | None:
        """Return bool [H, W], False where the image's pixels are ignored; None when all count. Raises NeecoError."""
        mask = self.frames[name].load_mask() if name in self.frames else None
        return None if mask is None else mask.numpy()


def parse_classes(words: Sequence[str], option: str) -> dict[int, str] | None:
    """Parse `shaft=1 wrist=2` as {1: "shaft", 2: "wrist"}; None when there are no words. Raises NeecoError."""
    names: dict[int, str] = {}
    for word in words:
        part, _, number = word.partition("=")
        if not part or not number.isdecimal() or not 1 <= int(number) <= 255:
            raise NeecoError(f"{option}: {word!r}: expected PART=ID with an id from 1 to 255, such as shaft=1")
        if int(number) in names:
            raise NeecoError(f"{option}: {word!r}: id {number} is named twice; give each id one part")
        names[int(number)] = part
    return names or None


def read_ids(path: Path) -> np.ndarray:
    """Read a mask as uint8 [H, W]: grey values, or a palette's indices (black and white palettes: 0 and 255). Raises
    NeecoError for anything but an opaque PNG of 8 bits without colours."""
    image = open_image(path)
    if image.format == "PNG" and image.mode in ("1", "L", "P", "LA", "RGB", "RGBA"):
        colors = np.asarray(image.convert("RGBA"))
        grey = colors[..., 0]
        is_grey = bool((colors[..., :3] == grey[..., None]).all())
        if image.mode == "P" and not (is_grey and np.isin(grey, (0, 255)).all()):
            return np.array(image)
        if is_grey and (image.mode == "P" or (colors[..., 3] == 255).all()):
            return np.ascontiguousarray(grey)
    raise NeecoError(
        f"{path}: a mask must be an opaque 8-bit PNG, grey or with a palette; this is {image.format}, {image.mode}: "
        "save its ids as that"
    )


def open_masks(path: Path, classes: Mapping[int, str] | None = None, option: str = "--classes") -> Masks:
    """Open a folder of masks: `NAME_parts.png` where there are such files, else `NAME_mask.png`, else `NAME.png`.

    classes: part by id; else as the folder's `parts.json` states; else ids 1 to 4 are shaft, wrist, jaw_left and
    jaw_right, and only 0 and 255 (or 1) a mask of the instrument. option: that the user sets `classes` with. Raises
    NeecoError.
    """
    if not path.is_dir():
        raise NeecoError(f"{path}: no such folder; give a folder of masks")
    pictures = {file.stem: file for file in visible_entries(path) if file.suffix.lower() == ".png" and file.is_file()}
    if not pictures:
        raise NeecoError(f"{path}: contains no PNG files; give the folder of the masks")
    for suffix in (PARTS_SUFFIX, MASK_SUFFIX, ""):
        files = {name.removesuffix(suffix): file for name, file in pictures.items() if name.endswith(suffix)}
        if files:
            break
    ids_of_file = {file: set(np.unique(read_ids(file)).tolist()) - {0} for file in files.values()}
    ids = set().union(*ids_of_file.values())
    notes: tuple[str, ...] = ()
    names = classes if classes is not None or suffix == MASK_SUFFIX else stated_names(path)
    part_of_id = {255: "instrument"} if suffix == MASK_SUFFIX else USUAL_NAMES
    if names is not None:
        part_of_id = names
    elif not suffix and ids in ({1}, {255}):
        part_of_id = dict.fromkeys(ids, "instrument")
        if ids == {1}:
            notes = (f"{path}: its ids are 0 and 1: read as a mask of the instrument; name parts with {option}",)
    elif suffix != MASK_SUFFIX:
        names = USUAL_NAMES
    for file, values in ids_of_file.items():
        if unknown := sorted(values - set(part_of_id)):
            meaning = ", ".join(f"{number} {part}" for number, part in part_of_id.items())
            raise NeecoError(f"{file}: id {unknown[0]} is not among {meaning}; name it with {option} PART={unknown[0]}")
    return Masks(path, files, names, notes)


def read_truth(path: Path) -> Capture | Path:
    """Read the capture in a folder; return the folder itself where it holds masks alone. Raises NeecoError."""
    if not path.is_dir():
        raise NeecoError(f"{path}: no such folder; give a capture or a folder of masks")
    is_capture = any((path / name).exists() for name in ("transforms.json", "truth", REFERENCE_FOLDER))
    return read_capture(path) if is_capture else path


def open_truth(
    truth: Capture | Path, classes: Mapping[int, str] | None = None, splits: Sequence[str] | None = None
) -> Masks:
    """Open the truth: a capture (`truth/masks`, else `reference_masks`, and its ignored pixels) or a folder of masks.

    splits: which frames of a capture; all that have a mask when None. Raises NeecoError.
    """
    if isinstance(truth, Path):
        if splits is not None:
            raise NeecoError(f"--splits: {truth} is a folder of masks and has no splits; give the capture instead")
        return open_masks(truth, classes, "--truth-classes")
    path = truth.root
    for split in splits or ():
        if split not in truth.splits:
            raise NeecoError(f"--splits: {path} has no split {split!r}; it has {', '.join(truth.splits)}")
    frames = truth.frames if splits is None else [frame for split in splits for frame in truth.split(split)]
    files: dict[str, Path] = {}
    masked: dict[str, Frame] = {}
    for frame in frames:
        file = truth_file(path, frame.name)
        if file is None:
            continue
        if frame.name in files:
            raise NeecoError(f"{path}: two frames are named {frame.name!r}, and masks go by name; give mask folders")
        masked[frame.name], files[frame.name] = frame, file
    if not files:
        raise NeecoError(f"{path}: its frames have no truth/masks and no {REFERENCE_FOLDER}; give a folder of masks")
    parts = all(file.parent.name != REFERENCE_FOLDER for file in files.values())
    if classes is not None and not parts:
        problem = f"{path / REFERENCE_FOLDER} tell the instrument, no parts"
        raise NeecoError(f"--truth-classes: {problem}; leave --truth-classes out")
    return Masks(path, files, (classes or truth_names(path)) if parts else None, capture=truth, frames=masked)


SCHEMA = "neeco-mask-scores/2"
SCORES: dict[str, Callable[..., float]] = {"iou": iou, "dice": dice, "boundary_f": boundary_f}


def score_masks(
    predicted: Path,
    truth: Capture | Path,
    *,
    splits: Sequence[str] | None = None,
    classes: Mapping[int, str] | None = None,
    truth_classes: Mapping[int, str] | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> dict[str, Any]:
    """Score a folder of masks against a capture's (read, or its folder) or another folder's, matched by file stem.

    splits: of a capture; None: those of which `predicted` has an image. classes, truth_classes: part by id, where ids
    differ from ours. progress: called with (done, of). An image without a prediction counts as predicted empty.
    `iou`, `dice`, `boundary_f`: means over the images where either side shows the region. `challenge_iou`: EndoVis
    2017's as in ISINet's evaluation (Gonzalez et al., MICCAI 2020, github.com/BCV-Uniandes/ISINet), per image the mean
    IoU of the classes its truth shows, mean over the images that show any. None is "not known", never zero. Raises
    NeecoError for what cannot be read or compared.
    """
    predictions = open_masks(predicted, classes)
    source = read_truth(truth) if isinstance(truth, Path) else truth
    truths = open_truth(source, truth_classes, None if isinstance(source, Capture) else splits)
    all_names = set(truths.files)
    if isinstance(source, Capture):
        predicted_frames = [frame for name, frame in truths.frames.items() if name in predictions.files]
        usual = dict.fromkeys(frame.split for frame in predicted_frames or truths.frames.values())
        truths = open_truth(source, truth_classes, splits or list(usual))
    if not set(predictions.files) & set(truths.files):
        names = f"{next(iter(predictions.files))!r} and {next(iter(truths.files))!r}"
        raise NeecoError(f"{predicted}: no mask is named like one of {truths.path} (such as {names}); rename the files")
    (ours, theirs), notes = _shared_classes(predictions, truths)
    numbers: dict[str, int] = {}  # of several ids of a part the first
    for number, part in theirs.items():
        numbers.setdefault(part, number)
    tables = [truth_table(names, theirs) for names in (ours, theirs)]
    whole = PartTally({1: "instrument"}, tuple(SCORES.values()))
    parts = PartTally({number: part for part, number in numbers.items()}, tuple(SCORES.values()))
    wholes, visible = list[list[str]](), list[list[str]]()  # of each image: whether its truth has the whole, the parts
    for index, name in enumerate(sorted(truths.files)):
        ids, counted = truths.load(name), truths.counted(name)
        guess = predictions.load(name) if name in predictions.files else np.zeros_like(ids)
        if guess.shape != ids.shape:
            size, true_size = (f"{image.shape[1]}x{image.shape[0]}" for image in (guess, ids))
            problem = f"size: mask is {size}, its truth is {true_size}; resize it (nearest)"
            raise NeecoError(f"{predictions.files[name]}: {problem}")
        whole.add((guess > 0).astype(np.uint8), (ids > 0).astype(np.uint8), counted)
        parts.add(tables[0][guess], tables[1][ids], counted)
        counting = ids if counted is None else ids[counted]
        present = np.unique(tables[1][counting])
        wholes.append(["instrument"] if counting.any() else [])
        visible.append([part for part, number in numbers.items() if number in present])
        if progress is not None:
            progress(index + 1, len(truths.files))
    swap, assignment = parts.swapped()
    rows = {part: _means(parts, swap.get(part, part), part) for part in part_scores(parts.names)}
    for part in dict.fromkeys(theirs.values()):
        if part not in ours.values():
            rows[part] = dict.fromkeys((*SCORES, "images"))
            notes.append(f"{part}: null, the prediction has no such part; it counts as not detected in Challenge IoU")
    instrument = _means(whole, "instrument", "instrument")
    if unnamed := [part for part, row in {"instrument": instrument, **rows}.items() if row["images"] == 0]:
        notes.append(f"{', '.join(unnamed)}: null, no image shows it")
    missing, extra = sorted(set(truths.files) - set(predictions.files)), sorted(set(predictions.files) - all_names)
    notes += [*predictions.notes, *truths.notes]
    if missing:
        notes.append(f"{len(missing)} of {len(truths.files)} images have no prediction and count as empty")
    if extra:
        notes.append(f"{len(extra)} predictions have no truth and were left out")
    return finite(
        {
            "schema": SCHEMA,
            "version": __version__,
            "predicted": str(predicted),
            "truth": str(truths.path),
            "splits": list(dict.fromkeys(frame.split for frame in truths.frames.values())) or None,
            "images": len(truths.files),
            "instrument": instrument | {"challenge_iou": _challenge(whole, wholes, {})},
            "parts": rows if theirs else None,
            "classes": {"challenge_iou": _challenge(parts, visible, swap)} if theirs else None,
            "pair_assignment": assignment,
            "per_image": [
                {"name": name} | dict(zip(SCORES, row["instrument", "instrument"], strict=True))
                for name, row in zip(sorted(truths.files), whole.rows, strict=True)
            ],
            "missing": missing,
            "extra": extra,
            "notes": notes,
        }
    )


def _shared_classes(predicted: Masks, truth: Masks) -> tuple[tuple[dict[int, str], dict[int, str]], list[str]]:
    """Return the parts by id, of the prediction and of the truth, in which two folders can be compared, and a note
    where there are none. Where either side has one name for a pair (jaws), the other's two become one."""
    ours, theirs = dict(predicted.names or {}), dict(truth.names or {})
    either = {*ours.values(), *theirs.values()}
    merged = {part: pair for pair, both in pairs_of(sorted(either)).items() if pair in either for part in both}
    ours, theirs = (
        {number: merged.get(names[number], names[number]) for number in sorted(names)} for names in (ours, theirs)
    )
    if sides := [str(masks.path) for masks in (predicted, truth) if masks.names is None]:
        return ({}, {}), [f"parts: null, {' and '.join(sides)} tell instrument from tissue only"]
    if not set(theirs.values()) & set(ours.values()):
        named = [", ".join(dict.fromkeys(names.values())) for names in (ours, theirs)]
        return ({}, {}), [f"parts: null, the prediction names {named[0]}, the truth {named[1]}"]
    return (ours, theirs), []


def _means(tally: PartTally, ours: str, theirs: str) -> dict[str, Any]:
    """Return the mean of each score, and the number of images where either side shows the region."""
    means = {name: tally.mean(ours, theirs, at) for at, name in enumerate(SCORES)}
    return means | {"images": sum(not math.isnan(row[ours, theirs][0]) for row in tally.rows)}


def _challenge(tally: PartTally, visible: Sequence[Sequence[str]], swap: Mapping[str, str]) -> float:
    """Return the Challenge IoU (see `score_masks`) over the parts of the tally that the truth of each image shows."""
    return mean_of(
        [
            mean_of([row[swap.get(part, part), part][0] for part in parts])
            for row, parts in zip(tally.rows, visible, strict=True)
        ]
    )
