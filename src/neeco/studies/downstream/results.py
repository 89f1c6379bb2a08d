"""Results of jobs: means over folds, paired differences with intervals, findings in words, tables.

A study's results are one document, that of downstream.json, of plain values: "jobs" as they wrote them, "summary",
"paired" and "answers" from here.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from neeco.errors import counted
from neeco.studies.downstream.conditions import BASELINES, PERMUTED, REAL
from neeco.studies.downstream.intervals import Arm, Scores, arms_of
from neeco.studies.downstream.scores import BOX_SCORES, MASK_SCORES
from neeco.studies.downstream.table_files import latex_document, summary_csv, write_files
from neeco.studies.study import spread
from neeco.studies.tables import (
    UNKNOWN,
    Cell,
    Column,
    ResultTable,
    Row,
    SummaryRow,
    csv_text,
    markdown_document,
    summary_table,
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
HELPS, HURTS, NONE_SHOWN = "helps", "hurts", "no difference shown"
VERDICTS = (HELPS, HURTS, NONE_SHOWN)
JOB_KEYS = ("model", "condition", "real", "fold")
KEYS = ("trained on", "labelled")
PAIRED_KEYS = ("model", "split", "metric", "condition", "real", "against", "against_real")
PAIRED_COLUMNS = (*PAIRED_KEYS, "folds", "difference", "low", "high")

Document = Mapping[str, Any]
FoldScores = Mapping[tuple[str, int], Mapping[int, float]]  # by (condition, labelled frames): the score by fold


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


def compared_metrics(jobs: Sequence[Document], predicts: str) -> list[str]:
    """The scores that have intervals: the main one, near pairs of parts, and of every class."""
    main = MAIN[predicts]
    found = metrics_of(jobs, predicts)
    return [key for key in found if key == main or key.startswith(NEAR) or key.endswith(f".{main}")]


def summarise_folds(jobs: Sequence[Document], models: Mapping[str, str], splits: Sequence[str]) -> list[dict[str, Any]]:
    """A row per arm and split; every score as {"mean", "std", "n"} over folds, compared ones with their interval's
    "low" and "high".

    models: what each predicts, by name. `failed` counts the folds that did not finish.
    """
    rows, scores = [], Scores(jobs)
    for arm in arms_of(jobs):
        of_model = [job for job in jobs if job["model"] == arm.model]
        metrics, compared = (take(of_model, models[arm.model]) for take in (metrics_of, compared_metrics))
        known = scores.jobs.get(arm, {}).values()
        count = sum((job["condition"], job["real"]) == arm[1:] for job in of_model)
        for split in splits:
            row = {**arm._asdict(), "split": split, "failed": count - len(known)}
            for metric in metrics:
                row[metric] = spread(job["splits"].get(split, {}).get(metric) for job in known)
                if metric in compared:
                    low, high = scores.interval(arm, split, metric)
                    row[metric] |= {"low": low, "high": high}
            rows.append(row)
    return rows


def comparisons(
    jobs: Sequence[Document], models: Mapping[str, str], splits: Sequence[str], sets: Sequence[str]
) -> list[dict[str, Any]]:
    """The differences that the study is about, over the folds that both finished, with their intervals.

    Every condition against the better of labelled frames alone and strongly augmented, at as many labelled frames (sets
    alone: at the most); strong augmentation against none; a set with a word that changes how it is used against the set
    as it is; the first set against each other set.
    """
    scores = Scores(jobs)
    arms = list(scores.jobs)
    metrics = {
        name: compared_metrics([job for job in jobs if job["model"] == name and "error" not in job], predicts)
        for name, predicts in models.items()
    }
    rows = []
    for first in arms:
        for split in splits:
            for second in _references(first, split, scores, MAIN[models[first.model]], sets):
                for metric in metrics[first.model]:
                    if (found := scores.difference(first, second, split, metric)) is None:
                        continue
                    folds, mean, ends = found
                    keys = (first.model, split, metric, *first[1:], *second[1:])
                    rows.append(dict(zip(PAIRED_COLUMNS, (*keys, folds, mean, *ends), strict=True)))
    return rows


def _references(first: Arm, split: str, scores: Scores, metric: str, sets: Sequence[str]) -> list[Arm]:
    """The arms that `first` is compared with on a split, in whatever order their conditions' words stand."""
    words, arms = set(first.words), [arm for arm in scores.jobs if arm.model == first.model]
    synthetic = [word for word in first.words if word in sets]

    def of(wanted: set[str], real: int = first.real) -> list[Arm]:
        return [arm for arm in arms if (set(arm.words), arm.real) == (wanted, real)]

    if PERMUTED in words:
        return of(words - {PERMUTED})
    baselines = [set(name.split("+")) for name in BASELINES]
    if words in baselines:
        return [arm for wanted in baselines[: baselines.index(words)] for arm in of(wanted)]
    most = max((arm.real for arm in arms if arm.condition == REAL), default=0)
    rivals = [arm for wanted in baselines for arm in of(wanted, first.real if REAL in words else most)]
    known = [(value, arm) for arm in rivals if (value := scores.mean(arm, split, metric)) is not None]
    found = [max(known, key=lambda pair: pair[0])[1]] if known else []
    if synthetic:
        found += of({word for word in words if word in sets or word == REAL})  # how the set is used
    if synthetic and synthetic == [sets[0]]:
        found += [arm for other in sets[1:] for arm in of(words - {sets[0]} | {other})]
    return [arm for arm in dict.fromkeys(found) if arm != first]


def models_and_splits(experiment: Document) -> list[tuple[Document, str]]:
    """Every model with every split."""
    return [(model, split) for model in experiment["models"] for split in experiment["splits"]]


def main_differences(experiment: Document, model: Document, split: str) -> list[Document]:
    """The paired differences of a model's main score on a split."""
    wanted = (model["name"], split, MAIN[model["answers"]])
    return [row for row in experiment["paired"] if (row["model"], row["split"], row["metric"]) == wanted]


def scores_by_fold(jobs: Sequence[Document], model: str, split: str, metric: str) -> FoldScores:
    """One model's scores on one split; folds that failed or lack it are left out."""
    scores = Scores([job for job in jobs if job["model"] == model])
    return {arm[1:]: values for arm in scores.jobs if (values := scores.by_fold(arm, split, metric))}


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
    sentences = [_finding(key, scores, experiment, model, split) for key in scores]
    controls = dict.fromkeys(condition for condition, _ in scores if PERMUTED in condition.split("+"))
    sentences += [_control(condition, experiment, model, split) for condition in controls]
    return [sentence for sentence in sentences if sentence]


def _control(condition: str, experiment: Document, model: Document, split: str) -> str | None:
    """Compare labels of other images with the right ones; None where these are missing."""
    rows = [row for row in main_differences(experiment, model, split) if row["condition"] == condition]
    if not rows:
        return None
    worse = sum(verdict(row) == HURTS for row in rows)
    each = ", ".join(f"{row['difference']:+.3f} at {row['real']}" for row in rows)
    return (
        f"{condition} against the right labels, {rows[0]['against']}: below by more than the interval at {worse} of "
        f"{len(rows)} numbers of labelled frames ({each})"
    )


def _finding(key: tuple[str, int], scores: FoldScores, experiment: Document, model: Document, split: str) -> str | None:
    """Compare one condition with labelled frames alone; None where there is nothing to compare."""
    (condition, real), metric = key, TITLES[MAIN[model["answers"]]]
    words = condition.split("+")
    sets = [entry for entry in experiment["sets"] if entry["name"] in words]
    rows = [
        row
        for row in main_differences(experiment, model, split)
        if (row["condition"], row["real"]) == key and row["against"] in BASELINES
    ]
    if not sets or not rows or PERMUTED in words:
        return None
    used = [word for word in words if word not in (REAL, *(entry["name"] for entry in sets))]
    count = " and ".join(f"{entry['images']:,} synthetic ({', '.join([entry['name'], *used])})" for entry in sets)
    value = float(np.mean(list(scores[key].values())))
    row = rows[0]
    against = f"{verdict(row)} against {title_of(row['against'], row['against_real'])} {_interval(row)}".lstrip()
    if REAL not in words:
        best = value - row["difference"]
        share = f", {100 * value / best:.1f} % of {best:.3f}" if best else ""
        return f"{count} and no manual label: {metric} {value:.3f}{share}; {against}"
    sentence = f"{real} labelled frames and {count}: {metric} {value:.3f}"
    curve = real_curve(scores, key)
    if len(curve) > 1 and verdict(row) != HURTS:
        sentence += f", {equivalent(curve, value)} labelled frames without synthetic images"
    return f"{sentence}; {against}"


def real_curve(scores: FoldScores, key: tuple[str, int]) -> list[tuple[int, float]]:
    """(labelled frames, score) of the better of labelled frames alone and strongly augmented, each set off from the
    score of `key` by their difference over the folds that both finished."""
    own = scores[key]
    value, curve = float(np.mean(list(own.values()))), dict[int, float]()
    for (condition, count), others in sorted(scores.items()):
        folds = own.keys() & others.keys()
        if set(condition.split("+")) in map(set, (name.split("+") for name in BASELINES)) and folds:
            score = value - float(np.mean([own[fold] - others[fold] for fold in sorted(folds)]))
            curve[count] = max(score, curve.get(count, score))
    return sorted(curve.items())


def verdict(row: Document) -> str:
    """Return the verdict of a paired difference, one of VERDICTS; "" of one fold, whose interval is of frames alone."""
    if row["low"] is None or row["folds"] < 2:
        return ""
    return HELPS if row["low"] > 0 else HURTS if row["high"] < 0 else NONE_SHOWN


def _interval(row: Document) -> str:
    if row["low"] is None:
        return f"({row['difference']:+.3f}; a single score has no interval)"
    if row["folds"] < 2:
        return f"({row['difference']:+.3f}; one fold gives no verdict)"
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
    """For every model and split the main score over labelled frames, its differences, then all scores."""
    makers = (curve_table, differences_table, scores_table)
    tables = [make(experiment, model, split) for model, split in models_and_splits(experiment) for make in makers]
    return [table for table in tables if table.rows]


def curve_table(experiment: Document, model: Document, split: str) -> ResultTable:
    """The main score by condition and number of labelled frames, with its interval."""
    metric = MAIN[model["answers"]]
    rows = [row for row in experiment["summary"] if (row["model"], row["split"]) == (model["name"], split)]
    found = {(row["condition"], row["real"]): row.get(metric) for row in rows}
    counts = sorted({real for _, real in found})
    means = {key: value["mean"] for key, value in found.items() if value and value["n"]}

    def cell(key: tuple[str, int]) -> Cell:
        if key not in means:
            return Cell(UNKNOWN)
        low, high = found[key].get("low"), found[key].get("high")
        text = f"{means[key]:.3f}" + ("" if low is None else f" ({low:.3f}–{high:.3f})")
        column = [value for (_, real), value in means.items() if real == key[1]]
        return Cell(text, best=len(column) > 1 and means[key] == max(column))

    entries = [
        Row((name,), tuple(cell((name, real)) for real in counts)) for name in dict.fromkeys(name for name, _ in found)
    ]
    columns = tuple(Column(str(real), f"{real:,}" if real else "none") for real in counts)
    title = f"{model['name']}, {split}: {TITLES[metric]} by labelled frames"
    return ResultTable(title, KEYS[:1], columns, tuple(entries))


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
    return summary_table(f"{name}, {split}: all scores", KEYS, columns, entries)


def differences_table(experiment: Document, model: Document, split: str) -> ResultTable:
    """The paired differences of the main score, with their intervals."""
    columns = (Column("difference", "difference"), Column("low", "95 % from"), Column("high", "to"))
    rows = []
    for row in main_differences(experiment, model, split):
        texts = [UNKNOWN if row[column.key] is None else f"{row[column.key]:+.3f}" for column in columns]
        against = title_of(row["against"], row["against_real"])
        rows.append(Row((*_keys(row), against), tuple(map(Cell, [*texts, str(row["folds"])]))))
    title = f"{model['name']}, {split}: differences of {TITLES[MAIN[model['answers']]]}"
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
    """Return the budget of every training and the number of seeds, in words."""
    models = [
        f"{model['name']}: {model['steps']} steps of {model['batch']} images of {model['input'][0]}x{model['input'][1]}"
        for model in experiment["models"]
    ]
    folds = experiment["folds"]
    return f"{'; '.join(models)}; {counted(folds, 'fold')}"


def data_files(experiment: Document) -> dict[str, str]:
    """The CSV files of `data/` by name, unrounded."""
    jobs, keys = experiment["jobs"], list(JOB_KEYS)
    of_job = [({key: job[key] for key in keys}, job) for job in jobs]
    scores = [own | {"split": split} | row for own, job in of_job for split, row in job["splits"].items()]
    frames = [
        {key: row[key] for key in (*keys, "split")} | frame for row in scores for frame in row.get("per_frame", [])
    ]
    columns = {
        "scores.csv": [key for key in _all_keys([*keys, "split"], scores) if key != "per_frame"],
        "frames.csv": _all_keys([*keys, "split", "frame"], frames),
        "jobs.csv": [*keys, "iterations", "seconds", "processor_seconds", "error"],
        "paired.csv": PAIRED_COLUMNS,
    }
    rows = (scores, frames, jobs, experiment["paired"])
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
