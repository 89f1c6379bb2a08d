"""Metrics between masks (intersection over union, Dice and boundary F, also per part); masks to compare: a capture's
truth or reference masks, and any folders of masks; scores of such folders against the truth.

For evaluation only: nothing that learns may read a capture's truth.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from scipy import ndimage
from torch import Tensor

from neeco import __version__
from neeco.base.errors import NeecoError
from neeco.base.files import finite, require_inside, visible_entries
from neeco.capture.checks.frames import MASK_FOLDERS, REFERENCE_FOLDER, USUAL_NAMES, stated_names
from neeco.capture.images import open_image, read_labels, read_mask
from neeco.capture.model import Capture, Frame
from neeco.capture.readers import read_capture
from neeco.labels.drawing import distances_to

_LEFT = re.compile(r"(?:^|_)left(?=_|$)")
BOUNDARY_TOLERANCE = 0.008  # of the image's diagonal, as DAVIS
Pixels = TypeVar("Pixels", Tensor, np.ndarray)


def iou(mask: Pixels, truth: Pixels, counted: Pixels | None = None) -> float:
    """Return the intersection over union of bool masks [H, W] over `counted` pixels; NaN when both are empty."""
    both, either = _overlap(mask, truth, counted)
    return both / either if either else math.nan


def dice(mask: Pixels, truth: Pixels, counted: Pixels | None = None) -> float:
    """Return the Dice coefficient (F1 of the pixels) of two bool masks [H, W]; NaN when both are empty."""
    both, either = _overlap(mask, truth, counted)
    return 2 * both / (both + either) if either else math.nan


def precision(mask: Pixels, truth: Pixels, counted: Pixels | None = None) -> float:
    """Return the share of a bool mask [H, W] that is true; recall with masks swapped. NaN when `mask` is empty."""
    if counted is not None:
        mask = mask & counted
    marked = int(mask.sum())
    return int((mask & truth).sum()) / marked if marked else math.nan


def _overlap(mask: Pixels, truth: Pixels, counted: Pixels | None) -> tuple[int, int]:
    if counted is not None:
        mask, truth = mask & counted, truth & counted
    return int((mask & truth).sum()), int((mask | truth).sum())


def truth_table(names: Mapping[int, str], truth: Mapping[int, str]) -> np.ndarray:
    """Return uint8 [256]: for each id, the truth's id of the part with this name (the first of several); 0 without one.
    names, truth: part by id."""
    numbers = {part: number for number, part in reversed([*truth.items()])}
    table = np.zeros(256, np.uint8)
    for number, part in names.items():
        table[number] = numbers.get(part, 0)
    return table


def pairs_of(parts: Iterable[str]) -> dict[str, tuple[str, str]]:
    """Return parts whose names differ by left and right, by their common name: {"jaws": ("jaw_left", "jaw_right")}.
    Images alone do not determine which of them is left."""
    names = tuple(parts)
    pairs = {}
    for left in names:
        right, count = _LEFT.subn(lambda match: match[0].replace("left", "right"), left)
        if count and right in names:
            pairs[_LEFT.sub("", left).strip("_") + "s"] = left, right
    return pairs


def part_scores(names: Mapping[int, str]) -> tuple[str, ...]:
    """Return the scored parts, where `names` are those of the truth by id, and each pair as one."""
    parts = tuple(dict.fromkeys(names.values()))
    return *parts, *pairs_of(parts)


@dataclass
class PartTally:
    """Scores per part over many images. names: part by id in the truth; scores: of masks, the IoU first.

    A scene learned from images cannot know which of a pair is left: the assignment that is better over all images is
    reported (never the better one per image).
    """

    names: Mapping[int, str]
    scores: tuple[Callable[..., float], ...] = (iou,)
    rows: list[dict[tuple[str, str], tuple[float, ...]]] = field(default_factory=list)  # by (part, part of the truth)

    def add(self, parts: Pixels, truth: Pixels, counted: Pixels | None = None) -> None:
        """Add one image: `parts` and `truth` [H, W] uint8, both in the truth's numbers."""
        ours, theirs = dict[str, Pixels](), dict[str, Pixels]()
        for masks, ids in ((ours, parts), (theirs, truth)):
            for number, part in self.names.items():  # a part may have several ids
                masks[part] = (ids == number) | masks.get(part, False)
        compared = [(part, part) for part in part_scores(self.names)]
        for pair, (left, right) in pairs_of(self.names.values()).items():
            for masks in (ours, theirs):
                masks[pair] = masks[left] | masks[right]
            compared += [(left, right), (right, left)]
        self.rows.append(
            {(a, b): tuple(score(ours[a], theirs[b], counted) for score in self.scores) for a, b in compared}
        )

    def swapped(self) -> tuple[dict[str, str], dict[str, str]]:
        """Return the parts to exchange, and the assignment of each pair: "swapped" if that fits better, else "as
        named"."""
        swap: dict[str, str] = {}
        assignment = {}
        for pair, (left, right) in pairs_of(self.names.values()).items():
            as_named, exchanged = (
                np.nansum([self.mean(ours, theirs) for ours, theirs in zip(order, (left, right), strict=True)])
                for order in ((left, right), (right, left))
            )
            assignment[pair] = "swapped" if exchanged > as_named else "as named"
            swap |= {left: right, right: left} if exchanged > as_named else {}
        return swap, assignment

    def mean(self, ours: str, theirs: str, score: int = 0) -> float:
        """Return the mean of a score of part `ours` against the truth's part `theirs`, over the images where either is
        shown; NaN where none is."""
        return mean_of([row[ours, theirs][score] for row in self.rows])

    def result(self) -> tuple[dict[str, float], dict[str, str]]:
        """Return the mean IoU per part over the images that show it (NaN when none does), and the assignment of each
        pair, "as named" or "swapped"."""
        swap, assignment = self.swapped()
        return {part: self.mean(swap.get(part, part), part) for part in part_scores(self.names)}, assignment


def mean_of(values: Sequence[float | None]) -> float:
    """Return the mean of the values that are numbers; NaN when there are none."""
    numbers = [value for value in values if value is not None and not math.isnan(value)]
    return sum(numbers) / len(numbers) if numbers else math.nan


def boundary_pixels(mask: np.ndarray) -> np.ndarray:
    """Return the contour of a bool mask [H, W]: pixels that differ from their right, lower or lower right neighbour."""
    padded = np.pad(mask, ((0, 1), (0, 1)), mode="edge")
    right, lower, diagonal = padded[:-1, 1:], padded[1:, :-1], padded[1:, 1:]
    return (mask ^ right) | (mask ^ lower) | (mask ^ diagonal)


def boundary_f(
    mask: np.ndarray, truth: np.ndarray, counted: np.ndarray | None = None, tolerance: float = BOUNDARY_TOLERANCE
) -> float:
    """Return the F-measure of two contours: the harmonic mean of the shares of each that are near the other.

    As Perazzi et al., "A benchmark dataset and evaluation methodology for video object segmentation", CVPR 2016, 4.1.

    mask, truth [H, W] bool; near: at most ceil(tolerance * diagonal) pixels apart, centre to centre. counted [H, W]:
    contour pixels outside it need no counterpart, but may be one. NaN when neither mask has a pixel that counts; 1 when
    there are pixels but neither has a contour (both fill the image), 0 when only one has.
    """
    everywhere = np.ones(mask.shape, bool) if counted is None else counted
    present = [bool((image & everywhere).any()) for image in (mask, truth)]
    if not any(present):
        return math.nan
    contours = boundary_pixels(mask), boundary_pixels(truth)
    judged = [int((contour & everywhere).sum()) for contour in contours]
    if not judged[0] or not judged[1]:
        return float(judged[0] == judged[1] and present[0] == present[1])
    radius = math.ceil(tolerance * math.hypot(*mask.shape))
    either = contours[0] | contours[1]
    (window,) = ndimage.find_objects(either.astype(np.uint8))  # distances outside it are never needed
    first, second, inside = (image[window] for image in (*contours, everywhere))
    near_second, near_first = (distances_to(contour) <= radius for contour in (second, first))
    precision = int((first & inside & near_second).sum()) / judged[0]
    recall = int((second & inside & near_first).sum()) / judged[1]
    return 2 * precision * recall / (precision + recall) if precision + recall else 0.0


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
    source = truth
    if isinstance(truth, Path):
        if not truth.is_dir():
            raise NeecoError(f"{truth}: no such folder; give a capture or a folder of masks")
        if any((truth / name).exists() for name in ("transforms.json", "truth", REFERENCE_FOLDER)):
            source = read_capture(truth)
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
