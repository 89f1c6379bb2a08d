"""Scores of any folder of masks against the truth: overlap, contours and boxes, per instrument and part."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from neeco import __version__
from neeco.capture.model import Capture, Frame
from neeco.errors import NeecoError
from neeco.evaluation.mask_folders import Masks, open_masks, open_truth, read_truth
from neeco.evaluation.mask_metrics import (
    assigned_pairs,
    average_precision,
    boundary_f,
    boxes_of,
    dice,
    iou,
    mean_of,
    pairs_of,
)
from neeco.files import finite

SCHEMA = "neeco-mask-scores/1"
OVERLAPS = ("iou", "dice", "boundary_f")  # of each image
SCORES = (*OVERLAPS, "box_ap", "box_ap50")
INSTRUMENT = "instrument"
Tables = Mapping[str, np.ndarray]  # bool [256] by region: which ids belong to it


@dataclass(frozen=True)
class Regions:
    """The compared regions: the instrument, the classes that both sides have, and each left-right pair as one."""

    classes: tuple[str, ...]  # without overlap; Challenge IoU is over these
    missing: tuple[str, ...]  # of `classes`, those that the prediction does not name
    predicted: Tables
    truth: Tables

    @property
    def pairs(self) -> dict[str, tuple[str, str]]:
        return pairs_of(self.classes)


@dataclass(frozen=True)
class _Image:
    """One image: overlaps by (predicted region, true region), boxes by region."""

    name: str
    overlaps: dict[tuple[str, str], dict[str, float]]
    predicted_boxes: dict[str, np.ndarray]
    true_boxes: dict[str, np.ndarray]

    def iou(self, region: str, swap: Mapping[str, str]) -> float:
        return self.overlaps[swap.get(region, region), region]["iou"]

    def shows(self, region: str) -> bool:
        return len(self.true_boxes[region]) > 0


def score_masks(
    predicted: Path,
    truth: Capture | Path,
    *,
    splits: Sequence[str] | None = None,
    classes: Mapping[int, str] | None = None,
    truth_classes: Mapping[int, str] | None = None,
    components: bool = False,
    progress: Callable[[int, int], None] | None = None,
) -> dict[str, Any]:
    """Score a folder of masks against a capture's (read, or its folder) or another folder's, matched by file stem.

    splits: of a capture; None: those of which `predicted` has an image. classes, truth_classes: part by id, where ids
    differ from ours. components: a box per connected group instead of one per id. progress: called with (done, of).
    An image without a prediction counts as predicted empty. Per region the mean over the images where either side
    shows it: `iou`, `dice`, `boundary_f`; over the whole folder `box_ap`, `box_ap50`
    (`average_precision`). `challenge_iou` is EndoVis 2017's as in ISINet's evaluation (Gonzalez et al., MICCAI
    2020, github.com/BCV-Uniandes/ISINet): per image the mean IoU of the classes its truth shows, mean over the images
    that show any; `isinet_iou` counts classes that either shows, `mean_class_iou` is the mean over classes of each
    one's mean over images. None is "not known", never zero. Raises NeecoError for what cannot be read or compared.
    """
    given = open_masks(predicted, classes)
    source = read_truth(truth) if isinstance(truth, Path) else truth
    wanted = open_truth(source, truth_classes, None if isinstance(source, Capture) else splits)
    everything = set(wanted.files)
    if isinstance(source, Capture):
        wanted = open_truth(source, truth_classes, splits or _predicted_splits(given, wanted))
    if not set(given.files) & set(wanted.files):
        names = f"{next(iter(given.files))!r} and {next(iter(wanted.files))!r}"
        raise NeecoError(f"{predicted}: no mask is named like one of {wanted.path} (such as {names}); rename the files")
    regions, reason = _shared_regions(given, wanted)
    images = []
    for index, name in enumerate(sorted(wanted.files)):
        images.append(_score_image(name, given, wanted, regions, components))
        if progress is not None:
            progress(index + 1, len(wanted.files))
    result = _summary(images, regions)
    notes = [*([reason] if reason else []), *result.pop("notes"), *given.notes, *wanted.notes]
    missing, extra = sorted(set(wanted.files) - set(given.files)), sorted(set(given.files) - everything)
    if missing:
        notes.append(f"{len(missing)} of {len(images)} images have no prediction and count as empty")
    if extra:
        notes.append(f"{len(extra)} predictions have no truth and were left out")
    return finite(
        {
            "schema": SCHEMA,
            "version": __version__,
            "predicted": str(predicted),
            "truth": str(wanted.path),
            "splits": _splits(wanted.frames.values()) or None,
            "images": len(images),
            **result,
            "boxes": f"one per {'connected group of pixels' if components else 'id'}, without confidence",
            "missing": missing,
            "extra": extra,
            "notes": notes,
        }
    )


def _splits(frames: Iterable[Frame]) -> list[str]:
    return list(dict.fromkeys(frame.split for frame in frames))


def _predicted_splits(predicted: Masks, truth: Masks) -> list[str]:
    """Return the splits that have predictions; all where none has."""
    found = _splits(frame for name, frame in truth.frames.items() if name in predicted.files)
    return found or _splits(truth.frames.values())


def _shared_regions(predicted: Masks, truth: Masks) -> tuple[Regions, str | None]:
    """Return the regions in which two folders can be compared, and why they have no parts, if so.

    Where either side has one name for a pair (jaws), the other's two become one.
    """
    ours, theirs = dict(predicted.names or {}), dict(truth.names or {})
    either = {*ours.values(), *theirs.values()}
    merged = {part: pair for pair, both in pairs_of(sorted(either)).items() if pair in either for part in both}
    ours, theirs = ({number: merged.get(part, part) for number, part in names.items()} for names in (ours, theirs))
    classes = list(dict.fromkeys(theirs[number] for number in sorted(theirs)))
    reason = None
    if sides := [str(masks.path) for masks in (predicted, truth) if masks.names is None]:
        reason = f"parts: null, {' and '.join(sides)} tell instrument from tissue only"
    elif not set(classes) & set(ours.values()):
        named = ", ".join(sorted(set(ours.values())))
        reason = f"parts: null, the prediction names {named}, the truth {', '.join(classes)}"
    if reason is not None:
        classes = []
    missing = tuple(part for part in classes if part not in ours.values())
    return Regions(tuple(classes), missing, _tables(ours, classes), _tables(theirs, classes)), reason


def _tables(names: Mapping[int, str], classes: Sequence[str]) -> Tables:
    tables = {INSTRUMENT: np.arange(256) > 0}
    for part in classes:
        tables[part] = np.isin(np.arange(256), [number for number, name in names.items() if name == part])
    for pair, (left, right) in pairs_of(classes).items():
        tables[pair] = tables[left] | tables[right]
    return tables


def _score_image(name: str, predicted: Masks, truth: Masks, regions: Regions, components: bool) -> _Image:
    ids, counted = truth.load(name), truth.counted(name)
    guess = predicted.load(name) if name in predicted.files else np.zeros_like(ids)
    if guess.shape != ids.shape:
        found, wanted = (f"{image.shape[1]}x{image.shape[0]}" for image in (guess, ids))
        raise NeecoError(f"{predicted.files[name]}: size: mask is {found}, its truth is {wanted}; resize it (nearest)")
    guesses = {region: table[guess] for region, table in regions.predicted.items()}
    truths = {region: table[ids] for region, table in regions.truth.items()}
    everywhere = True if counted is None else counted
    pairs = [(region, region) for region in truths]
    pairs += [way for left, right in regions.pairs.values() for way in ((left, right), (right, left))]
    return _Image(
        name,
        {(ours, theirs): _overlap(guesses[ours], truths[theirs], counted) for ours, theirs in pairs},
        {region: boxes_of(mask & everywhere, components) for region, mask in guesses.items()},
        {region: boxes_of(mask & everywhere, components) for region, mask in truths.items()},
    )


def _overlap(mask: np.ndarray, truth: np.ndarray, counted: np.ndarray | None) -> dict[str, float]:
    """Return IoU, Dice and boundary F; NaN where neither mask has a pixel that counts."""
    overlap = iou(mask, truth, counted)
    contours = math.nan if math.isnan(overlap) else boundary_f(mask, truth, counted)
    return {"iou": overlap, "dice": dice(mask, truth, counted), "boundary_f": contours}


def _summary(images: Sequence[_Image], regions: Regions) -> dict[str, Any]:
    """Return numbers per region, pairs assigned as fits the whole folder better (see `mask_metrics.PartTally`)."""

    def mean_iou(ours: str, theirs: str) -> float:
        return mean_of([image.overlaps[ours, theirs]["iou"] for image in images])

    swap, assignment = assigned_pairs(regions.pairs, mean_iou)
    numbers = {region: _region_numbers(images, region, swap) for region in regions.truth}
    notes = []
    for part in regions.missing:
        numbers[part] = dict.fromkeys((*SCORES, "images"))
        notes.append(f"{part}: null, the prediction has no such part; it counts as not found in Challenge IoU")
    if unnamed := [part for part, value in numbers.items() if value["images"] == 0]:
        notes.append(f"{', '.join(unnamed)}: null, no image shows it")
    instrument = numbers.pop(INSTRUMENT) | {"challenge_iou": _challenge(images, (INSTRUMENT,), {})[0]}
    overall = None
    if regions.classes:
        challenge, isinet = _challenge(images, regions.classes, swap)
        class_iou = mean_of([mean_iou(swap.get(part, part), part) for part in regions.classes])
        overall = {"challenge_iou": challenge, "isinet_iou": isinet, "mean_class_iou": class_iou}
    return {
        INSTRUMENT: instrument,
        "parts": numbers if regions.classes else None,
        "classes": overall,
        "pair_assignment": assignment,
        "per_image": [{"name": image.name} | image.overlaps[INSTRUMENT, INSTRUMENT] for image in images],
        "notes": notes,
    }


def _region_numbers(images: Sequence[_Image], region: str, swap: Mapping[str, str]) -> dict[str, Any]:
    source = swap.get(region, region)
    rows = [image.overlaps[source, region] for image in images]
    numbers: dict[str, Any] = {key: mean_of([row[key] for row in rows]) for key in OVERLAPS}
    boxes = [image.predicted_boxes[source] for image in images], [image.true_boxes[region] for image in images]
    numbers["box_ap"] = average_precision(*boxes)
    numbers["box_ap50"] = average_precision(*boxes, thresholds=(0.5,))
    return numbers | {"images": sum(not math.isnan(row["iou"]) for row in rows)}


def _challenge(images: Sequence[_Image], classes: Sequence[str], swap: Mapping[str, str]) -> tuple[float, float]:
    """Return Challenge IoU, and the IoU that also counts classes only predicted (see `score_masks`)."""
    in_truth = [mean_of([image.iou(part, swap) for part in classes if image.shows(part)]) for image in images]
    in_either = [mean_of([image.iou(part, swap) for part in classes]) for image in images]
    return mean_of(in_truth), mean_of(in_either)
