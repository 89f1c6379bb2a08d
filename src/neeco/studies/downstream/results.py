"""Results of jobs: means over folds, paired differences with intervals, findings in words, tables.

A study's results are one document, that of downstream.json, of plain values: "jobs" as they wrote them, "summary",
"paired" and "answers" from here. An arm is what is averaged over folds: a model, a condition and a number of labelled
frames.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy import stats

from neeco.studies.downstream.job import AUGMENT, REAL
from neeco.studies.downstream.scores import BOX_SCORES, MASK_SCORES
from neeco.studies.study import spread
from neeco.studies.tables import (
    UNKNOWN,
    Cell,
    Column,
    ResultTable,
    Row,
    SummaryRow,
    csv_text,
    latex_document,
    markdown_document,
    summary_csv,
    summary_table,
    write_files,
)

MAIN = {"masks": "iou", "boxes": "ap"}  # the score that models are compared by
TITLES = {
    "iou": "IoU",
    "dice": "Dice",
    "precision": "precision",
    "recall": "recall",
    "boundary_f": "boundary F",
    "ap": "AP50-95",
    "ap50": "AP50",
    "ap75": "AP75",
    "box_precision": "precision",
    "box_recall": "recall",
}
NEAR = "iou_"  # begins the score near a pair of parts: iou_jaws
CONFIDENCE = 0.95  # of intervals
HELPS, HURTS, NONE_SHOWN = "helps", "hurts", "no difference shown"
VERDICTS = (HELPS, HURTS, NONE_SHOWN)
JOB_KEYS = ("model", "condition", "real", "fold")
KEYS = ("trained on", "labelled")
PAIRED_KEYS = ("model", "split", "metric", "condition", "real", "against", "against_real")
PAIRED_COLUMNS = (*PAIRED_KEYS, "folds", "difference", "low", "high")

Document = Mapping[str, Any]
Scores = Mapping[tuple[str, int], Mapping[int, float]]  # by (condition, labelled frames): the score by fold


class Arm(NamedTuple):
    """A model in a condition with so many labelled frames."""

    model: str
    condition: str
    real: int

    @property
    def words(self) -> list[str]:
        """The words of its condition."""
        return self.condition.split("+")


def arms_of(jobs: Sequence[Document]) -> list[Arm]:
    """The arms of these jobs, in their order."""
    return list(dict.fromkeys(Arm(job["model"], job["condition"], job["real"]) for job in jobs))


def title_of(condition: str, real: int) -> str:
    """`kinematic+real, 20 labelled`."""
    return f"{condition}, {real} labelled" if real else condition


def failed_jobs(experiment: Document) -> list[str]:
    """`model, condition, …: why` of every job that failed."""
    return [
        f"{job['model']}, {job['condition']}, {job['real']} labelled, fold {job['fold']}: {job['error']}"
        for job in experiment["jobs"]
        if "error" in job
    ]


def metrics_of(jobs: Sequence[Document], predicts: str) -> list[str]:
    """The scores that these jobs have, the usual ones first, then those of classes."""
    usual = list(MASK_SCORES if predicts == "masks" else BOX_SCORES)
    scores = [split for job in jobs for split in job["splits"].values()]
    found = dict.fromkeys(key for split in scores for key, value in split.items() if isinstance(value, float))
    of_pairs = [key for key in found if predicts == "masks" and key.startswith(NEAR)]
    return [*(key for key in usual if key in found), *of_pairs, *(key for key in found if "." in key)]


def summarise_folds(jobs: Sequence[Document], models: Mapping[str, str], splits: Sequence[str]) -> list[dict[str, Any]]:
    """A row per arm and split; every score as {"mean", "std", "n"} over folds.

    models: what each predicts, by name. `failed` counts the folds that did not finish.
    """
    rows = []
    for arm in arms_of(jobs):
        same = [job for job in jobs if _is_of(job, arm)]
        done = [job for job in same if "error" not in job]
        metrics = metrics_of([job for job in jobs if job["model"] == arm.model], models[arm.model])
        for split in splits:
            scores = {metric: spread(job["splits"].get(split, {}).get(metric) for job in done) for metric in metrics}
            rows.append({**arm._asdict(), "split": split, "failed": len(same) - len(done), **scores})
    return rows


def _is_of(row: Document, arm: Arm) -> bool:
    return (row["model"], row["condition"], row["real"]) == arm


def scores_by_fold(jobs: Sequence[Document], model: str, split: str, metric: str) -> Scores:
    """One model's scores on one split; folds that failed or lack it are left out."""
    scores: dict[tuple[str, int], dict[int, float]] = {}
    for job in jobs:
        value = job["splits"].get(split, {}).get(metric)
        if job["model"] == model and value is not None:
            scores.setdefault((job["condition"], job["real"]), {})[job["fold"]] = value
    return scores


def paired(jobs: Sequence[Document], first: Arm, second: Arm, split: str, metric: str) -> dict[str, Any] | None:
    """Compare `first` with `second` (of one model) on the folds that both finished: the mean difference of scores,
    and the interval that holds the mean with 95 % confidence (Student's t; None for a single fold)."""
    scores = scores_by_fold(jobs, first.model, split, metric)
    ours, theirs = (scores.get(arm[1:], {}) for arm in (first, second))
    differences = np.array([ours[fold] - theirs[fold] for fold in ours if fold in theirs])
    folds = len(differences)
    if not folds:
        return None
    mean, low, high = float(differences.mean()), None, None
    if folds > 1:
        reach = stats.t.ppf((1 + CONFIDENCE) / 2, folds - 1) * differences.std(ddof=1) / math.sqrt(folds)
        low, high = mean - float(reach), mean + float(reach)
    keys = (first.model, split, metric, first.condition, first.real, second.condition, second.real)
    return dict(zip(PAIRED_COLUMNS, (*keys, folds, mean, low, high), strict=True))


def comparisons(
    jobs: Sequence[Document], models: Mapping[str, str], splits: Sequence[str], sets: Sequence[str]
) -> list[dict[str, Any]]:
    """The differences that the study is about, over the jobs that finished.

    With synthetic images against without, at every number of labelled frames; synthetic images alone against the most
    labelled frames; the first set against each other set, alone and with labelled frames; every condition that does
    something to a set (`set+soft`) against the set as it is.
    """
    done = [job for job in jobs if "error" not in job]
    metrics = {
        name: metrics_of([job for job in done if job["model"] == name], predicts) for name, predicts in models.items()
    }
    arms = arms_of(done)
    rows = (
        paired(done, first, second, split, metric)
        for first in arms
        for second in _references(first, arms, sets)
        for split in splits
        for metric in metrics[first.model]
    )
    return [row for row in rows if row is not None]


def _references(first: Arm, arms: Sequence[Arm], sets: Sequence[str]) -> list[Arm]:
    """The arms that `first` is compared with, in whatever order their conditions' words stand."""
    synthetic = [word for word in first.words if word in sets]
    wanted: list[tuple[set[str], int]] = [({REAL}, first.real)]
    if synthetic and REAL in first.words:
        wanted += [({REAL, AUGMENT}, first.real)]
    elif synthetic:
        most = max((arm.real for arm in arms if arm[:2] == (first.model, REAL)), default=0)
        wanted = [({REAL}, most)]
    if synthetic:  # how the set is used
        wanted += [({word for word in first.words if word in sets or word == REAL}, first.real)]
    if synthetic and synthetic == [sets[0]]:
        wanted += [({other if word == sets[0] else word for word in first.words}, first.real) for other in sets[1:]]
    found = [
        arm
        for words, real in wanted
        for arm in arms
        if (arm.model, set(arm.words), arm.real) == (first.model, words, real)
    ]
    return [arm for arm in dict.fromkeys(found) if arm != first]


def models_and_splits(experiment: Document) -> list[tuple[Document, str]]:
    """Every model with every split."""
    return [(model, split) for model in experiment["models"] for split in experiment["splits"]]


def main_differences(experiment: Document, model: Document, split: str) -> list[Document]:
    """The paired differences of a model's main score on a split."""
    wanted = (model["name"], split, MAIN[model["answers"]])
    return [row for row in experiment["paired"] if (row["model"], row["split"], row["metric"]) == wanted]


def findings(experiment: Document) -> list[str]:
    """Return the findings: a sentence for every model, split and condition with synthetic images."""
    return [
        f"{model['name']}, {split}: {sentence}"
        for model, split in models_and_splits(experiment)
        for sentence in findings_of(experiment, model, split)
    ]


def findings_of(experiment: Document, model: Document, split: str) -> list[str]:
    """The sentences of one model and split; conditions are compared over the folds that both finished."""
    scores = scores_by_fold(experiment["jobs"], model["name"], split, MAIN[model["answers"]])
    sentences = (_finding(key, scores, experiment, model, split) for key in scores)
    return [sentence for sentence in sentences if sentence]


def _finding(key: tuple[str, int], scores: Scores, experiment: Document, model: Document, split: str) -> str | None:
    """Compare one condition with labelled frames alone; None where there is nothing to compare."""
    (condition, real), metric = key, TITLES[MAIN[model["answers"]]]
    words = condition.split("+")
    sets = [entry for entry in experiment["sets"] if entry["name"] in words]
    curve = real_curve(scores, key)
    if not sets or not curve:
        return None
    used = [word for word in words if word not in (REAL, *(entry["name"] for entry in sets))]
    count = " and ".join(f"{entry['images']:,} synthetic ({', '.join([entry['name'], *used])})" for entry in sets)
    value = float(np.mean(list(scores[key].values())))
    if REAL not in words:
        most, best = curve[-1]
        share = f"{100 * value / best:.1f} % of what" if best else "where"
        reference = f"{share} {most} labelled frames alone reach ({best:.3f})"
        return f"{count} and no manual label: {metric} {value:.3f}, {reference}"
    rows = {
        row["against"]: row
        for row in main_differences(experiment, model, split)
        if (row["condition"], row["real"], row["against_real"]) == (condition, real, real)
    }
    judged = [
        (verdict(rows[against]), f"against {title} {_interval(rows[against])}")
        for against, title in ((REAL, "them alone"), (f"{REAL}+{AUGMENT}", "them augmented"))
        if against in rows
    ]
    if not judged:
        return None
    sentence = f"{real} labelled frames and {count}: {metric} {value:.3f}"
    if len(curve) > 1 and judged[0][0] != HURTS:
        sentence += f", {equivalent(curve, value)} labelled frames alone"
    return "; ".join([sentence, *(f"{word} {how}".lstrip() for word, how in judged)])


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


def verdict(row: Document) -> str:
    """Return the verdict of a paired difference, one of VERDICTS; "" where there is no interval."""
    if row["low"] is None:
        return ""
    return HELPS if row["low"] > 0 else HURTS if row["high"] < 0 else NONE_SHOWN


def _interval(row: Document) -> str:
    if row["low"] is None:
        return f"({row['difference']:+.3f}; one fold has no interval)"
    return f"({row['difference']:+.3f}, {row['low']:+.3f} to {row['high']:+.3f})"


def equivalent(curve: Sequence[tuple[int, float]], value: float) -> str:
    """`as good as about 40` of the curve's (labelled frames, score), read between its points along log frames."""
    counts, scores = [count for count, _ in curve], list(np.maximum.accumulate([score for _, score in curve]))
    if value >= scores[-1]:
        return f"at least as good as {counts[-1]}"
    if value < scores[0]:
        return f"not as good as {counts[0]}"
    after = next(k for k, score in enumerate(scores) if score > value)
    low, high = scores[after - 1], scores[after]
    share = (value - low) / (high - low)
    as_many = counts[after - 1] * (counts[after] / counts[after - 1]) ** share
    return f"as good as about {as_many:.0f}"


def tables_of(experiment: Document) -> list[ResultTable]:
    """For every model and split the scores of each condition, then the differences of its main score."""
    pairs = models_and_splits(experiment)
    tables = [table(experiment, model, split) for model, split in pairs for table in (scores_table, differences_table)]
    return [table for table in tables if table.rows]


def scores_table(experiment: Document, model: Document, split: str) -> ResultTable:
    """The scores of each condition, mean and standard deviation over folds."""
    name, jobs = model["name"], [job for job in experiment["jobs"] if job["model"] == model["name"]]
    order = list(dict.fromkeys(job["condition"] for job in experiment["jobs"]))
    rows = [row for row in experiment["summary"] if (row["model"], row["split"]) == (name, split)]
    rows.sort(key=lambda row: (row["real"], order.index(row["condition"])))
    columns = [Column(metric, _metric_title(metric), 3, "high") for metric in metrics_of(jobs, model["answers"])]
    entries = []
    for row in rows:
        same = [job for job in jobs if (job["condition"], job["real"]) == (row["condition"], row["real"])]
        failed = same[0]["error"] if all("error" in job for job in same) else None
        entries.append(SummaryRow(_keys(row), row, failed))
    return summary_table(f"{name}, split {split}", KEYS, columns, entries)


def differences_table(experiment: Document, model: Document, split: str) -> ResultTable:
    """The paired differences of the main score, with their intervals."""
    columns = (Column("difference", "difference"), Column("low", "95 % from"), Column("high", "to"))
    rows = []
    for row in main_differences(experiment, model, split):
        texts = [UNKNOWN if row[column.key] is None else f"{row[column.key]:+.3f}" for column in columns]
        against = title_of(row["against"], row["against_real"])
        rows.append(Row((*_keys(row), against), tuple(map(Cell, [*texts, str(row["folds"])]))))
    title = f"{model['name']}, split {split}: differences of {TITLES[MAIN[model['answers']]]}"
    return ResultTable(title, (*KEYS, "against"), (*columns, Column("folds", "folds")), tuple(rows))


def _keys(row: Document) -> tuple[str, str]:
    return row["condition"], f"{row['real']:,}" if row["real"] else "none"


def _metric_title(metric: str) -> str:
    """A score's title; of a class `jaws IoU`, near a pair of parts `IoU near the jaws`."""
    if metric.startswith(NEAR):
        return f"IoU near the {metric.removeprefix(NEAR).replace('_', ' ')}"
    name, _, score = metric.rpartition(".")
    return f"{name} {TITLES[score]}".strip()


def budget_text(experiment: Document) -> str:
    """Return the budget of every training and the number of folds, in words."""
    models = [
        f"{model['name']}: {model['steps']} steps of {model['batch']} images of {model['input'][0]}x{model['input'][1]}"
        for model in experiment["models"]
    ]
    folds = experiment["folds"]
    return f"{'; '.join(models)}; {folds} fold{'s' if folds > 1 else ''}"


def data_files(experiment: Document) -> dict[str, str]:
    """The CSV files of `data/` by name, unrounded."""
    jobs, keys = experiment["jobs"], list(JOB_KEYS)
    of_job = [({key: job[key] for key in keys}, job) for job in jobs]
    scores = [own | {"split": split} | row for own, job in of_job for split, row in job["splits"].items()]
    frames = [
        {key: row[key] for key in (*keys, "split")} | frame for row in scores for frame in row.get("per_frame", [])
    ]
    curves = [own | {"step": step, "score": score} for own, job in of_job for step, score in job.get("validation", [])]
    columns = {
        "scores.csv": [key for key in _all_keys([*keys, "split"], scores) if key != "per_frame"],
        "frames.csv": _all_keys([*keys, "split", "frame"], frames),
        "jobs.csv": [*keys, "iterations", "best_step", "seconds", "processor_seconds", "error"],
        "validation.csv": [*keys, "step", "score"],
        "paired.csv": PAIRED_COLUMNS,
    }
    rows = (scores, frames, jobs, curves, experiment["paired"])
    return {name: csv_text(columns[name], some) for name, some in zip(columns, rows, strict=True)}


def _all_keys(first: Sequence[str], rows: Sequence[Document]) -> list[str]:
    return list(dict.fromkeys([*first, *(key for row in rows for key in row)]))


def summary_text(experiment: Document) -> str:
    """CSV with a line per arm and split, unrounded."""
    rows = experiment["summary"]
    metrics = list(dict.fromkeys(key for row in rows for key in row if isinstance(row[key], dict)))
    return summary_csv(["model", "condition", "real", "split", "failed"], metrics, rows)


def write_tables(output: Path, experiment: Document) -> None:
    """Write downstream.csv, .md and .tex, and data/*.csv behind them, into `output`."""
    name, tables, budget = Path(experiment["capture"]).name, tables_of(experiment), budget_text(experiment)
    notes, found = experiment["notes"], experiment["answers"]
    texts = {
        "csv": summary_text(experiment),
        "md": markdown_document(f"Downstream on {name}", f"{budget}.", tables, "folds", notes, found),
        "tex": latex_document(f"{name}, {{}}. {budget}.", tables, [], notes),
    }
    write_files(output, "downstream", texts, data_files(experiment))
