"""Scores of any folder of masks against the truth: overlap and contours, per instrument and part."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from neeco import __version__
from neeco.base.errors import NeecoError
from neeco.base.files import finite
from neeco.capture.model import Capture
from neeco.evaluation.mask_folders import Masks, open_masks, open_truth, read_truth
from neeco.evaluation.mask_metrics import PartTally, boundary_f, dice, iou, mean_of, pairs_of, part_scores, truth_table

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
