"""Results of a downstream study, stored in downstream.json: scores of predictions (masks per frame, boxes per split),
intervals over folds and frames, findings and tables."""

from __future__ import annotations

import contextlib
import io
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import product
from typing import Any, ClassVar, NamedTuple

import numpy as np

from neeco.evaluation.masks import boundary_f, dice, iou, mean_of, precision
from neeco.studies.configurations import UNKNOWN, Cell, Column, ResultTable, Row, csv_text
from neeco.studies.downstream.samples import Example
from neeco.studies.downstream.training_data import BASELINES, PERMUTED, REAL

MASK_SCORES = ("iou", "dice", "precision", "recall", "boundary_f")
BOX_SCORES = ("ap", "ap50", "ap75")
MAIN = {"masks": "iou", "boxes": "ap"}  # main score, for comparing models
TITLES = {"iou": "IoU", "dice": "Dice", "boundary_f": "boundary F", "ap": "AP50-95", "ap50": "AP50", "ap75": "AP75"}
HELPS, HURTS, NONE_SHOWN, ONE_FOLD = "helps", "hurts", "no difference shown", "one fold gives no verdict"

Document = Mapping[str, Any]


@dataclass(frozen=True)
class Detections:
    """The detections in one image, in order of decreasing score."""

    boxes: np.ndarray  # [n, 4] x0, y0, x1, y1 px
    classes: np.ndarray  # [n] int64, from 1
    scores: np.ndarray  # [n] in [0, 1]

    def of_class(self, number: int) -> tuple[np.ndarray, np.ndarray]:
        """Return boxes [m, 4] and scores [m] of one class."""
        return self.boxes[self.classes == number], self.scores[self.classes == number]


Prediction = np.ndarray | Detections  # classes of pixels uint8 [H, W], 0 tissue; or boxes


def mask_scores(predicted: np.ndarray, truth: Example, classes: Sequence[str]) -> dict[str, float]:
    """Return the scores of one frame by name; for several classes their means, and `CLASS.score`.

    predicted: uint8 [H, W]. NaN if the class is neither predicted nor labelled.
    """
    valid = truth.valid if truth.valid is not None else np.ones(predicted.shape, bool)
    scores = []
    for number in range(1, len(classes) + 1):
        mask, true = predicted == number, truth.classes == number
        row = {"iou": iou(mask, true, valid), "dice": dice(mask, true, valid)}
        row |= {"precision": precision(mask, true, valid), "recall": precision(true, mask, valid)}
        scores.append(row | {"boundary_f": boundary_f(mask, true, valid)})
    if len(classes) == 1:
        return scores[0]
    named = {f"{name}.{key}": value for name, row in zip(classes, scores, strict=True) for key, value in row.items()}
    return {key: mean_of([row[key] for row in scores]) for key in MASK_SCORES} | named


def mean_scores(frames: Sequence[Mapping[str, float]]) -> dict[str, float | None]:
    """Return the mean of every score over the frames that have it; None if none has."""
    names = dict.fromkeys(name for frame in frames for name in frame)
    means = {name: mean_of([frame.get(name) for frame in frames]) for name in names}
    return {name: None if math.isnan(value) else value for name, value in means.items()}


def box_scores(
    predictions: Sequence[Detections], truth: Sequence[Example], classes: Sequence[str]
) -> dict[str, float | None]:
    """Return COCO's box AP: mean over IoU 0.5 to 0.95, at 0.5 and at 0.75; for several classes the mean, and
    `CLASS.ap`. None if the ground truth has no box."""
    from pycocotools.coco import COCO
    from pycocotools.cocoeval import COCOeval

    def box_of(image: int, box: np.ndarray) -> dict[str, object]:
        x0, y0, x1, y1 = map(float, box)
        bbox = [x0, y0, x1 - x0, y1 - y0]
        return {"image_id": image, "bbox": bbox, "area": bbox[2] * bbox[3], "category_id": 1}

    per_class: dict[str, list[float]] = {}
    true_boxes = [example.boxes() for example in truth]
    for number, name in enumerate(classes, 1):
        labelled = [
            box_of(image, box)
            for image, (boxes, numbers) in enumerate(true_boxes, 1)
            for box in boxes[numbers == number]
        ]
        detections = [
            box_of(image, box) | {"score": float(score)}
            for image, each in enumerate(predictions, 1)
            for box, score in zip(*each.of_class(number), strict=True)
        ]
        if not labelled:
            continue
        per_class[name] = [0.0, 0.0, 0.0]
        if detections:
            with contextlib.redirect_stdout(io.StringIO()):
                true = COCO()
                images = [{"id": image} for image in range(1, len(truth) + 1)]
                annotations = [box | {"id": number, "iscrowd": 0} for number, box in enumerate(labelled, 1)]
                true.dataset = {"info": {}, "images": images, "categories": [{"id": 1}], "annotations": annotations}
                true.createIndex()
                evaluation = COCOeval(true, true.loadRes(detections), "bbox")
                evaluation.evaluate()
                evaluation.accumulate()
                evaluation.summarize()
            per_class[name] = evaluation.stats[:3].tolist()
    if not per_class:
        return dict.fromkeys(BOX_SCORES)
    means = np.mean(list(per_class.values()), axis=0).tolist()
    scores: dict[str, float | None] = dict(zip(BOX_SCORES, means, strict=True))
    return scores | ({f"{name}.ap": row[0] for name, row in per_class.items()} if len(classes) > 1 else {})


def box_iou(detections: Detections, truth: Example) -> float:
    """Return the mean IoU of every true box with the most confident box of its class; NaN without true boxes."""
    values = []
    for box, number in zip(*truth.boxes(), strict=True):
        boxes, scores = detections.of_class(number)
        best = boxes[scores.argmax()] if len(scores) else np.zeros(4)
        both = np.prod(np.clip(np.minimum(best[2:], box[2:]) - np.maximum(best[:2], box[:2]), 0, None))
        areas = [np.prod(corners[2:] - corners[:2]) for corners in (best, box)]
        values.append(float(both / (sum(areas) - both)))
    return mean_of(values)


class Arm(NamedTuple):
    """A model in a condition with a number of labelled frames."""

    model: str
    condition: str
    real: int


class Estimate(NamedTuple):
    """A mean over folds with the ends of its interval, which are None for a single value."""

    folds: int
    mean: float
    low: float | None
    high: float | None


class Scores:
    """Scores of a study's finished jobs by arm, test and metric, with intervals of means and differences.

    All arms use the same resampled seeds and frames, so that differences are paired.
    """

    confidence: ClassVar[float] = 0.95  # of the intervals, by bootstrap
    resamples: ClassVar[int] = 2000
    blocks: ClassVar[int] = 10  # blocks of neighbouring frames, whose errors are correlated, that are resampled

    def __init__(self, jobs: Sequence[Document]) -> None:
        self.jobs: dict[Arm, dict[int, Document]] = {}
        for job in jobs:
            if "error" not in job:
                arm = Arm(job["model"], job["condition"], job["real"])
                self.jobs.setdefault(arm, {})[job["fold"]] = job
        self._resampled: dict[Any, np.ndarray] = {}

    def by_fold(self, arm: Arm, test: str, metric: str) -> dict[int, float]:
        """Return the score of every fold that has it."""
        scores = {fold: job["splits"].get(test, {}).get(metric) for fold, job in self.jobs.get(arm, {}).items()}
        return {fold: score for fold, score in sorted(scores.items()) if score is not None}

    def mean(self, arm: Arm, test: str, metric: str) -> float | None:
        """Return the mean score over folds; None if no fold has it."""
        values = self.by_fold(arm, test, metric)
        return float(np.mean(list(values.values()))) if values else None

    def estimate(self, arm: Arm, test: str, metric: str, against: Arm | None = None) -> Estimate | None:
        """Return the mean of an arm's score over folds, or of its difference to another arm over their common folds;
        None if there is no such fold."""
        values = [self.by_fold(one, test, metric) for one in ((arm,) if against is None else (arm, against))]
        folds = tuple(fold for fold in values[0] if fold in values[-1])
        if not folds:
            return None
        mean = float(np.mean([values[0][fold] - (values[1][fold] if against else 0) for fold in folds]))
        means = self._means(arm, test, metric, folds)
        if against is not None:
            means = means - self._means(against, test, metric, folds)
        if not len(means):
            return Estimate(len(folds), mean, None, None)
        tail = (1 - self.confidence) / 2
        low, high = np.nanquantile(means, [tail, 1 - tail])
        return Estimate(len(folds), mean, float(low), float(high))

    def _means(self, arm: Arm, test: str, metric: str, folds: tuple[int, ...]) -> np.ndarray:
        """Return means over resampled seeds and frames [R]; [0] for one seed without scores per frame."""
        key = arm, test, metric, folds
        if key not in self._resampled:
            rows = []
            for fold in folds:
                scores = self.jobs[arm][fold]["splits"][test]
                frames = [frame.get(metric) for frame in scores.get("per_frame", ())]
                rows.append(frames if any(value is not None for value in frames) else [scores[metric]])
            values = np.array(rows, np.float64)  # [seeds, frames]; None becomes NaN: a frame without the class
            seeds, frames_drawn = seed_weights(len(folds)), block_weights(values.shape[1])
            valid = ~np.isnan(values)
            total, count = (((seeds @ part) * frames_drawn).sum(1) for part in (np.nan_to_num(values), valid))
            self._resampled[key] = total / np.where(count > 0, count, np.nan) if values.size > 1 else np.empty(0)
        return self._resampled[key]


@cache
def seed_weights(seeds: int) -> np.ndarray:
    """Return resampling counts of each seed [R, seeds], with one draw fewer than seeds, because as many draws would
    underestimate the variance of few (Rao and Wu, "Resampling inference with complex survey data", 1988)."""
    times, rng = max(seeds - 1, 1), np.random.default_rng(1)
    return rng.multinomial(times, np.full(seeds, 1 / seeds), Scores.resamples).astype(np.float64)


@cache
def block_weights(frames: int) -> np.ndarray:
    """Return resampling counts of each frame [R, frames], in circular blocks of neighbours (Politis and Romano, "A
    circular block-resampling procedure", 1992)."""
    length = -(-frames // Scores.blocks)
    starts = np.random.default_rng(2).integers(frames, size=(Scores.resamples, -(-frames // length)))
    ends = np.zeros((Scores.resamples, 2 * frames + 1))
    rows = np.arange(Scores.resamples)[:, None]
    np.add.at(ends, (rows, starts), 1)
    np.add.at(ends, (rows, starts + length), -1)
    covered = ends.cumsum(1)
    return covered[:, :frames] + covered[:, frames : 2 * frames]


def words_of(condition: str) -> set[str]:
    """Return the terms of a condition, without their order."""
    return set(condition.split("+"))


def title_of(condition: str, real: int) -> str:
    """Format an arm as `kinematic+real, 20 labelled`."""
    return f"{condition}, {real} labelled" if real else condition


def failed_jobs(experiment: Document) -> list[str]:
    """Format every failed job as `model, condition, …: reason`."""
    return [
        f"{job['model']}, {title_of(job['condition'], job['real'])}, fold {job['fold']}: {job['error']}"
        for job in experiment["jobs"]
        if "error" in job
    ]


def metrics_of(jobs: Sequence[Document], predicts: str) -> list[str]:
    """Return the score names of these jobs, the main one first; for several classes followed by the class scores."""
    metrics = {key for job in jobs for split in job["splits"].values() for key in split}
    classes = sorted(key for key in metrics if key.endswith(f".{MAIN[predicts]}"))
    return [*(MASK_SCORES if predicts == "masks" else BOX_SCORES), *classes]


def summarise(jobs: Sequence[Document], models: Mapping[str, str], tests: Sequence[str]) -> list[dict[str, Any]]:
    """Return a row per arm and test: means of scores over `folds`, the 95 % interval of the main one as "low" and
    "high", and its "difference" to the arm "against" over common folds, with an interval and a "verdict". models: kind
    of prediction by name."""
    rows, scores = [], Scores(jobs)
    for arm in dict.fromkeys(Arm(job["model"], job["condition"], job["real"]) for job in jobs):
        main = MAIN[models[arm.model]]
        metrics = metrics_of([job for job in jobs if job["model"] == arm.model], models[arm.model])
        for test in tests:
            score = scores.estimate(arm, test, main) or Estimate(0, math.nan, None, None)
            row: dict[str, Any] = {**arm._asdict(), "test": test, "folds": score.folds}
            row |= {metric: scores.mean(arm, test, metric) for metric in metrics}
            row |= {"low": score.low, "high": score.high}
            reference = _reference(arm, test, scores, main)
            if reference is not None and (gain := scores.estimate(arm, test, main, reference)) is not None:
                row |= {"against": reference.condition, "against_real": reference.real, "difference": gain.mean}
                row |= {"difference_low": gain.low, "difference_high": gain.high}
                row["verdict"] = verdict(gain.folds, gain.low, gain.high)
            rows.append(row)
    return rows


def _reference(arm: Arm, test: str, scores: Scores, metric: str) -> Arm | None:
    """Return the reference of `arm` on a test: the better of labelled frames alone and strongly augmented, with the
    same number of labelled frames (sets alone: the maximum); for permuted labels the correct ones."""
    words, baselines = words_of(arm.condition), [words_of(name) for name in BASELINES]
    other_arms = [other for other in scores.jobs if other.model == arm.model and other != arm]
    references, real = baselines, arm.real
    if PERMUTED in words:
        references = [words - {PERMUTED}]
    elif words in baselines:
        references = baselines[: baselines.index(words)]
    elif REAL not in words:
        real = max((other.real for other in other_arms if words_of(other.condition) in baselines), default=0)
    rivals = [
        (mean, other)
        for other in other_arms
        if words_of(other.condition) in references
        and other.real == real
        and (mean := scores.mean(other, test, metric)) is not None
    ]
    return max(rivals)[1] if rivals else None


def verdict(folds: int, low: float | None, high: float | None) -> str:
    """Return the verdict on a difference over this number of folds by its interval; none for one fold."""
    if low is None or high is None or folds < 2:
        return ONE_FOLD
    return HELPS if low > 0 else HURTS if high < 0 else NONE_SHOWN


def rows_of(experiment: Document, model: Document, test: str) -> list[Document]:
    """Return the summary of a model on a test, in order of the number of labelled frames."""
    rows = [row for row in experiment["summary"] if (row["model"], row["test"]) == (model["name"], test)]
    return sorted(rows, key=lambda row: row["real"])


def is_synthetic(row: Document, experiment: Document) -> bool:
    """Return whether a row's condition has a set with its correct labels."""
    words = words_of(row["condition"])
    return PERMUTED not in words and any(entry["name"] in words for entry in experiment["sets"])


def findings(experiment: Document) -> list[str]:
    """Return a sentence for every model, test and condition with synthetic images that has a reference."""
    sentences = []
    for model, test in product(experiment["models"], experiment["tests"]):
        for row in rows_of(experiment, model, test):
            if "against" in row and (is_synthetic(row, experiment) or PERMUTED in words_of(row["condition"])):
                score = f"{_title(MAIN[model['predicts']])} {row[MAIN[model['predicts']]]:.3f}"
                against = f"{title_of(row['against'], row['against_real'])} ({_difference(row)})"
                arm = f"{model['name']}, {test}: {title_of(row['condition'], row['real'])}"
                sentences.append(f"{arm}: {score}; {row['verdict']} against {against}")
    return sentences


def _difference(row: Document) -> str:
    """Format a difference as `+0.021, +0.003 to +0.040`."""
    ends = "" if row["difference_low"] is None else f", {row['difference_low']:+.3f} to {row['difference_high']:+.3f}"
    return f"{row['difference']:+.3f}{ends}"


def table_of(experiment: Document, model: Document, test: str) -> ResultTable:
    """Return all scores of a model on a test, means over folds; the main one with interval and difference."""
    rows, metrics = rows_of(experiment, model, test), metrics_of(experiment["jobs"], model["predicts"])
    main = metrics[0]
    best = max((row[main] for row in rows if row[main] is not None), default=None)
    errors = {(job["condition"], job["real"]): job["error"] for job in experiment["jobs"] if "error" in job}
    entries = []
    for row in rows:
        texts = [UNKNOWN if row.get(metric) is None else f"{row[metric]:.3f}" for metric in metrics]
        if row["low"] is not None:
            texts[0] += f" ({row['low']:.3f}–{row['high']:.3f})"
        if "against" in row:
            texts += [_difference(row), row["verdict"], title_of(row["against"], row["against_real"])]
        texts += [""] * (len(metrics) + 3 - len(texts))
        cells = (Cell(texts[0], best=len(rows) > 1 and row[main] == best), *map(Cell, texts[1:]))
        failed = None if row["folds"] else errors.get((row["condition"], row["real"]))
        entries.append(Row((row["condition"], f"{row['real']:,}" if row["real"] else "none"), cells, failed))
    columns = [Column(metric, _title(metric), 3, "high") for metric in metrics]
    columns += [Column(name, name) for name in ("difference", "verdict", "against")]
    return ResultTable(f"{model['name']}, {test}", ("trained on", "labelled"), tuple(columns), tuple(entries))


def _title(metric: str) -> str:
    """Return a score's title, for one class as `jaws IoU`."""
    name, _, score = metric.rpartition(".")
    return f"{name} {TITLES.get(score, score)}".strip()


def tables_of(experiment: Document) -> list[ResultTable]:
    """Return the tables of all models and tests."""
    return [table_of(experiment, *pair) for pair in product(experiment["models"], experiment["tests"])]


def summary_text(experiment: Document) -> str:
    """Return CSV with a line per arm and test, unrounded."""
    rows = experiment["summary"]
    return csv_text(list(dict.fromkeys(key for row in rows for key in row)), rows)
