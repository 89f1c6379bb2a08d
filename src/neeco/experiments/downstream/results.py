"""From jobs to what they say: means over folds, paired differences with their intervals, and answers in words."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from scipy import stats

from neeco.experiments.downstream.conditions import AUGMENT, REAL
from neeco.experiments.downstream.scores import BOX_SCORES, MASK_SCORES
from neeco.experiments.study import spread

MAIN = {"masks": "iou", "boxes": "ap"}
TITLES = {
    "iou": "IoU",
    "dice": "Dice",
    "precision": "precision",
    "recall": "recall",
    "boundary_f": "boundary F",
    "iou_jaws": "IoU near the jaws",
    "ap": "AP50-95",
    "ap50": "AP50",
    "ap75": "AP75",
    "box_precision": "precision",
    "box_recall": "recall",
}
CONFIDENCE = 0.95  # of intervals
LEAST_FOLDS = 2  # for an interval
HELPS, HURTS, NONE_SHOWN = "helps", "hurts", "no difference shown"
VERDICTS = (HELPS, HURTS, NONE_SHOWN)

Row = Mapping[str, Any]


def metrics_of(jobs: Sequence[Row], answers: str) -> list[str]:
    """The scores that these jobs have, the usual ones first, then those of classes."""
    usual = [*MASK_SCORES, "iou_jaws"] if answers == "masks" else list(BOX_SCORES)
    found = dict.fromkeys(
        key
        for job in jobs
        for scores in job["splits"].values()
        for key, value in scores.items()
        if isinstance(value, float)
    )
    return [key for key in usual if key in found] + [key for key in found if "." in key]


def summarise_folds(jobs: Sequence[Row], models: Mapping[str, str], splits: Sequence[str]) -> list[dict[str, Any]]:
    """A row per model, condition, count of labelled frames and split; every score as {"mean", "std", "n"} over folds.

    models: what each answers with, by name. `failed` counts the folds that did not finish.
    """
    rows = []
    for model, condition, real in dict.fromkeys((job["model"], job["condition"], job["real"]) for job in jobs):
        same = [job for job in jobs if (job["model"], job["condition"], job["real"]) == (model, condition, real)]
        done = [job for job in same if "error" not in job]
        metrics = metrics_of([job for job in jobs if job["model"] == model], models[model])
        for split in splits:
            row: dict[str, Any] = {"model": model, "condition": condition, "real": real, "split": split}
            row["failed"] = len(same) - len(done)
            row |= {metric: spread([job["splits"].get(split, {}).get(metric) for job in done]) for metric in metrics}
            rows.append(row)
    return rows


def paired(
    jobs: Sequence[Row], first: tuple[str, str, int], second: tuple[str, str, int], split: str, metric: str
) -> dict[str, Any] | None:
    """How much better `first` (model, condition, labelled frames) does than `second` on the folds that both finished:
    the mean difference, and the interval in which its mean lies with 95 % (Student's t; None for a single fold)."""
    scores = by_fold(jobs, first[0], split, metric)
    ours, theirs = (scores.get(key[1:], {}) for key in (first, second))
    folds = [fold for fold in ours if fold in theirs]
    if not folds:
        return None
    differences = np.array([ours[fold] - theirs[fold] for fold in folds])
    row: dict[str, Any] = {"model": first[0], "split": split, "metric": metric, "condition": first[1], "real": first[2]}
    row |= {"against": second[1], "against_real": second[2], "folds": len(folds)}
    row |= {"difference": float(differences.mean()), "low": None, "high": None}
    if len(folds) >= LEAST_FOLDS:
        reach = stats.t.ppf((1 + CONFIDENCE) / 2, len(folds) - 1) * differences.std(ddof=1) / math.sqrt(len(folds))
        row |= {"low": row["difference"] - float(reach), "high": row["difference"] + float(reach)}
    return row


def comparisons(
    jobs: Sequence[Row], models: Mapping[str, str], splits: Sequence[str], sets: Sequence[str]
) -> list[dict[str, Any]]:
    """The differences that the experiment is about.

    With drawn images against without, at every count of labelled frames; drawn images alone against the most labelled
    frames; the first set against each other set, alone and beside labelled frames; every condition that does something
    to a set (`set+soft`) against the set as it is.
    """
    keys = list(dict.fromkeys((job["model"], job["condition"], job["real"]) for job in jobs))
    rows = []
    metrics = {name: metrics_of([job for job in jobs if job["model"] == name], kind) for name, kind in models.items()}
    for first in keys:
        for second in _against(first, keys, sets):
            for split in splits:
                for metric in metrics[first[0]]:
                    row = paired(jobs, first, second, split, metric)
                    rows += [] if row is None else [row]
    return rows


def _against(
    first: tuple[str, str, int], keys: Sequence[tuple[str, str, int]], sets: Sequence[str]
) -> list[tuple[str, str, int]]:
    model, condition, real = first
    words = condition.split("+")
    drawn = [word for word in words if word in sets]
    wanted: list[tuple[set[str], int]] = []
    if not drawn:
        wanted += [({REAL}, real)]
    elif REAL in words:
        wanted += [({REAL}, real), ({REAL, AUGMENT}, real)]
    else:
        most = max((key[2] for key in keys if key[:2] == (model, REAL)), default=0)
        wanted += [({REAL}, most)]
    if drawn:  # how the set is used
        wanted += [({word for word in words if word in sets or word == REAL}, real)]
    if drawn and drawn == [sets[0]]:
        wanted += [({other if word == sets[0] else word for word in words}, real) for other in sets[1:]]
    found = [key for some, count in wanted for key in keys if _is(key, model, some, count)]
    return [key for key in dict.fromkeys(found) if key != first]


def _is(key: tuple[str, str, int], model: str, words: set[str], real: int) -> bool:
    """Whether a key is of these words, in whatever order."""
    return (key[0], set(key[1].split("+")), key[2]) == (model, words, real)


def answers_of(document: Row) -> list[str]:
    """What the numbers say, a sentence each, for every model, split and condition with drawn images.

    Conditions are compared over the folds that both finished.
    """
    told = []
    for model in document["models"]:
        for split in document["splits"]:
            scores = by_fold(document["jobs"], model["name"], split, MAIN[model["answers"]])
            sentences = (_answer(key, scores, document, model, split) for key in scores)
            told += [f"{model['name']}, {split}: {sentence}" for sentence in sentences if sentence]
    return told


Scores = Mapping[tuple[str, int], Mapping[int, float]]  # by (condition, labelled frames): the score by fold


def by_fold(jobs: Sequence[Row], model: str, split: str, metric: str) -> Scores:
    """One model's scores on one split; folds that failed or lack it are left out."""
    scores: dict[tuple[str, int], dict[int, float]] = {}
    for job in jobs:
        value = job["splits"].get(split, {}).get(metric)
        if job["model"] == model and value is not None:
            scores.setdefault((job["condition"], job["real"]), {})[job["fold"]] = value
    return scores


def _answer(key: tuple[str, int], scores: Scores, document: Row, model: Row, split: str) -> str | None:
    """One condition beside labelled frames alone; None where there is nothing to say."""
    (condition, real), metric = key, MAIN[model["answers"]]
    words = condition.split("+")
    drawn = [entry for entry in document["sets"] if entry["name"] in words]
    curve = real_curve(scores, key)
    if not drawn or not curve:
        return None
    used = [word for word in words if word not in (REAL, *(entry["name"] for entry in drawn))]
    count = " and ".join(f"{entry['images']:,} drawn ({', '.join([entry['name'], *used])})" for entry in drawn)
    value = float(np.mean(list(scores[key].values())))
    if REAL not in words:
        most, best = curve[-1]
        share = f"{100 * value / best:.1f} % of what" if best else "where"
        return (
            f"{count} and no manual label: {TITLES[metric]} {value:.3f}, {share} {most} labelled frames "
            f"alone teach ({best:.3f})"
        )
    sentence = f"{real} labelled frames and {count}: {TITLES[metric]} {value:.3f}"
    verdicts = []
    for against, title in ((REAL, "them alone"), (f"{REAL}+{AUGMENT}", "them augmented")):
        entry = _difference(document, (model["name"], split, metric, condition, real, against, real))
        if entry is not None:
            verdicts.append((verdict(entry), f"against {title} {_interval(entry)}"))
    if not verdicts:
        return None
    if len(curve) > 1 and verdicts[0][0] != HURTS:
        sentence += f", {equivalent(curve, value)}"
    return sentence + "".join("; " + f"{told} {how}".lstrip() for told, how in verdicts)


def real_curve(scores: Scores, key: tuple[str, int]) -> list[tuple[int, float]]:
    """(labelled frames, score) of labelled frames alone, each set off from the score of `key` by their difference over
    the folds that both finished."""
    own = scores[key]
    value, curve = float(np.mean(list(own.values()))), []
    for (condition, count), others in sorted(scores.items()):
        folds = own.keys() & others.keys()
        if condition == REAL and folds:
            curve.append((count, value - float(np.mean([own[fold] - others[fold] for fold in sorted(folds)]))))
    return curve


def _difference(document: Row, wanted: tuple[Any, ...]) -> Row | None:
    keys = ("model", "split", "metric", "condition", "real", "against", "against_real")
    return next((entry for entry in document["paired"] if tuple(entry[key] for key in keys) == wanted), None)


def verdict(entry: Row) -> str:
    """What a paired difference allows to say: one of VERDICTS; "" where there is no interval."""
    if entry["low"] is None:
        return ""
    return HELPS if entry["low"] > 0 else HURTS if entry["high"] < 0 else NONE_SHOWN


def _interval(entry: Row) -> str:
    if entry["low"] is None:
        return f"({entry['difference']:+.3f}; one fold has no interval)"
    return f"({entry['difference']:+.3f}, {entry['low']:+.3f} to {entry['high']:+.3f})"


def equivalent(real: Sequence[tuple[int, float]], value: float) -> str:
    """As how many labelled frames alone: the curve of (frames, score) is read between its points along log frames."""
    counts, scores = [count for count, _ in real], list(np.maximum.accumulate([score for _, score in real]))
    if value >= scores[-1]:
        return f"at least as good as {counts[-1]} labelled frames alone"
    if value < scores[0]:
        return f"not as good as {counts[0]} labelled frames alone"
    after = next(k for k, score in enumerate(scores) if score > value)
    low, high = scores[after - 1], scores[after]
    share = (value - low) / (high - low)
    as_many = counts[after - 1] * (counts[after] / counts[after - 1]) ** share
    return f"as good as about {as_many:.0f} labelled frames alone"
