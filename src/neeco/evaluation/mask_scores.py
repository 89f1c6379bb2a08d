"""Scores of any folder of masks against the truth: overlap, contours and boxes, per instrument and part."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from neeco import __version__
from neeco.base.errors import NeecoError
from neeco.base.files import finite
from neeco.capture.model import Capture, Frame
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

SCHEMA = "neeco-mask-scores/1"
OVERLAPS = ("iou", "dice", "boundary_f")  # of each image
SCORES = (*OVERLAPS, "box_ap", "box_ap50")
INSTRUMENT = "instrument"
Tables = Mapping[str, np.ndarray]  # bool [256] by region: which ids belong to it


class _Image(NamedTuple):
    """One image: overlaps by (predicted region, true region), boxes by region."""

    name: str
    overlaps: dict[tuple[str, str], dict[str, float]]
    predicted_boxes: dict[str, np.ndarray]
    true_boxes: dict[str, np.ndarray]


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
    classes_of, notes = _shared_classes(given, wanted)
    tables = tuple(_tables(names) for names in classes_of)
    images = []
    for index, name in enumerate(sorted(wanted.files)):
        images.append(_score_image(name, given, wanted, tables, components))
        if progress is not None:
            progress(index + 1, len(wanted.files))
    result = _summary(images, *classes_of)
    notes += [*result.pop("notes"), *given.notes, *wanted.notes]
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


def _tables(names: Mapping[int, str]) -> Tables:
    """Return the compared regions: the instrument, its parts, and each left-right pair as one."""
    tables = {INSTRUMENT: np.arange(256) > 0}
    for part in dict.fromkeys(names.values()):
        tables[part] = np.isin(np.arange(256), [number for number, name in names.items() if name == part])
    for pair, (left, right) in pairs_of(names.values()).items():
        tables[pair] = tables[left] | tables[right]
    return tables


def _score_image(name: str, predicted: Masks, truth: Masks, tables: Sequence[Tables], components: bool) -> _Image:
    ids, counted = truth.load(name), truth.counted(name)
    guess = predicted.load(name) if name in predicted.files else np.zeros_like(ids)
    if guess.shape != ids.shape:
        found, wanted = (f"{image.shape[1]}x{image.shape[0]}" for image in (guess, ids))
        raise NeecoError(f"{predicted.files[name]}: size: mask is {found}, its truth is {wanted}; resize it (nearest)")
    truths = {region: table[ids] for region, table in tables[1].items()}
    guesses = {region: tables[0].get(region, np.zeros(256, bool))[guess] for region in truths}
    everywhere = True if counted is None else counted
    pairs = [(region, region) for region in truths]
    pairs += [way for left, right in pairs_of(truths).values() for way in ((left, right), (right, left))]
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


def _summary(images: Sequence[_Image], predicted: Mapping[int, str], truth: Mapping[int, str]) -> dict[str, Any]:
    """Return numbers per region, pairs assigned as fits the whole folder better (see `mask_metrics.PartTally`)."""
    classes = tuple(dict.fromkeys(truth.values()))  # without overlap; Challenge IoU is over these

    def mean_iou(ours: str, theirs: str) -> float:
        return mean_of([image.overlaps[ours, theirs]["iou"] for image in images])

    def challenge(regions: Sequence[str]) -> tuple[float, float]:
        """Challenge IoU, and the IoU that also counts regions only predicted (see `score_masks`)."""
        rows = [{part: image.overlaps[swap.get(part, part), part]["iou"] for part in regions} for image in images]
        shown = [[part for part in regions if len(image.true_boxes[part])] for image in images]
        in_truth = [mean_of([row[part] for part in parts]) for row, parts in zip(rows, shown, strict=True)]
        return mean_of(in_truth), mean_of([mean_of(list(row.values())) for row in rows])

    swap, assignment = assigned_pairs(pairs_of(classes), mean_iou)
    numbers: dict[str, dict[str, Any]] = {}
    notes = []
    for region in images[0].true_boxes:
        numbers[region] = _region_numbers(images, region, swap)
        if region in classes and region not in predicted.values():
            numbers[region] = dict.fromkeys((*SCORES, "images"))
            notes.append(f"{region}: null, the prediction has no such part; it counts as not found in Challenge IoU")
    if unnamed := [part for part, value in numbers.items() if value["images"] == 0]:
        notes.append(f"{', '.join(unnamed)}: null, no image shows it")
    instrument = numbers.pop(INSTRUMENT) | {"challenge_iou": challenge((INSTRUMENT,))[0]}
    overall = None
    if classes:
        in_truth, in_either = challenge(classes)
        class_iou = mean_of([mean_iou(swap.get(part, part), part) for part in classes])
        overall = {"challenge_iou": in_truth, "isinet_iou": in_either, "mean_class_iou": class_iou}
    return {
        INSTRUMENT: instrument,
        "parts": numbers if classes else None,
        "classes": overall,
        "pair_assignment": assignment,
        "per_image": [{"name": image.name} | image.overlaps[INSTRUMENT, INSTRUMENT] for image in images],
        "notes": notes,
    }


def _region_numbers(images: Sequence[_Image], region: str, swap: Mapping[str, str]) -> dict[str, Any]:
    source = swap.get(region, region)
    rows = [image.overlaps[source, region] for image in images]
    boxes = [image.predicted_boxes[source] for image in images], [image.true_boxes[region] for image in images]
    return {
        **{key: mean_of([row[key] for row in rows]) for key in OVERLAPS},
        "box_ap": average_precision(*boxes),
        "box_ap50": average_precision(*boxes, thresholds=(0.5,)),
        "images": sum(not math.isnan(row["iou"]) for row in rows),
    }
