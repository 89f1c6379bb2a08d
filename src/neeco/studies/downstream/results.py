"""Results of jobs: means over folds and differences with their intervals, findings in words, tables.

A study's results are one document, that of downstream.json, of plain values: "jobs" as they wrote them, "summary" and
"findings" from here.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from neeco.base.errors import counted
from neeco.base.files import write_text
from neeco.studies.downstream.conditions import BASELINES, PERMUTED, REAL
from neeco.studies.downstream.intervals import Arm, Scores, arms_of
from neeco.studies.downstream.scores import BOX_SCORES, MASK_SCORES
from neeco.studies.tables import UNKNOWN, Cell, Column, ResultTable, Row, csv_text, markdown_document

MAIN = {"masks": "iou", "boxes": "ap"}  # the score that models are compared by
TITLES = {"iou": "IoU", "dice": "Dice", "boundary_f": "boundary F", "ap": "AP50-95", "ap50": "AP50", "ap75": "AP75"}
HELPS, HURTS, NONE_SHOWN, ONE_FOLD = "helps", "hurts", "no difference shown", "one fold gives no verdict"

Document = Mapping[str, Any]


def title_of(condition: str, real: int) -> str:
    """`kinematic+real, 20 labelled`."""
    return f"{condition}, {real} labelled" if real else condition


def failed_jobs(experiment: Document) -> list[str]:
    """`model, condition, …: why` of every job that failed."""
    return [
        f"{job['model']}, {title_of(job['condition'], job['real'])}, fold {job['fold']}: {job['error']}"
        for job in experiment["jobs"]
        if "error" in job
    ]


def metrics_of(jobs: Sequence[Document], predicts: str) -> list[str]:
    """The scores that these jobs have, the main one first; of several classes that of each behind them."""
    found = {key for job in jobs for split in job["splits"].values() for key in split}
    classes = sorted(key for key in found if key.endswith(f".{MAIN[predicts]}"))
    return [*(MASK_SCORES if predicts == "masks" else BOX_SCORES), *classes]


def summarise(jobs: Sequence[Document], models: Mapping[str, str], tests: Sequence[str]) -> list[dict[str, Any]]:
    """A row per arm and test: means of scores over `folds`, the 95 % interval of the main one as "low" and "high", and
    its "difference" to the arm "against" over the folds that both finished, with an interval and a "verdict".

    models: what each predicts, by name. A condition is compared with the better of labelled frames alone and strongly
    augmented, at as many labelled frames (sets alone: at the most); strong augmentation with none; permuted labels with
    the right ones.
    """
    rows, scores = [], Scores(jobs)
    for arm in arms_of(jobs):
        main = MAIN[models[arm.model]]
        metrics = metrics_of([job for job in jobs if job["model"] == arm.model], models[arm.model])
        for test in tests:
            folds = len(scores.by_fold(arm, test, main))
            row: dict[str, Any] = {**arm._asdict(), "test": test, "folds": folds}
            row |= {metric: scores.mean(arm, test, metric) for metric in metrics}
            row["low"], row["high"] = scores.interval(arm, test, main)
            reference = _reference(arm, test, scores, main)
            if reference is not None and (found := scores.difference(arm, reference, test, main)) is not None:
                both, difference, (low, high) = found
                row |= {"against": reference.condition, "against_real": reference.real, "difference": difference}
                row |= {"difference_low": low, "difference_high": high, "verdict": verdict(both, low, high)}
            rows.append(row)
    return rows


def _reference(arm: Arm, test: str, scores: Scores, metric: str) -> Arm | None:
    """The arm that `arm` is compared with on a test, in whatever order their conditions' words stand."""
    words, baselines = set(arm.words), [set(name.split("+")) for name in BASELINES]
    others = [other for other in scores.jobs if other.model == arm.model and other != arm]
    wanted, real = baselines, arm.real
    if PERMUTED in words:
        wanted = [words - {PERMUTED}]
    elif words in baselines:
        wanted = baselines[: baselines.index(words)]
    elif REAL not in words:
        real = max((other.real for other in others if set(other.words) in baselines), default=0)
    rivals = [
        (value, other)
        for other in others
        if set(other.words) in wanted and other.real == real and (value := scores.mean(other, test, metric)) is not None
    ]
    return max(rivals)[1] if rivals else None


def verdict(folds: int, low: float | None, high: float | None) -> str:
    """Return the verdict of a difference over so many folds by its interval; of one fold that is of frames alone."""
    if low is None or high is None or folds < 2:
        return ONE_FOLD
    return HELPS if low > 0 else HURTS if high < 0 else NONE_SHOWN


def rows_of(experiment: Document, model: Document, test: str) -> list[Document]:
    """The summary of a model on a test, by the number of labelled frames."""
    rows = [row for row in experiment["summary"] if (row["model"], row["test"]) == (model["name"], test)]
    return sorted(rows, key=lambda row: row["real"])


def models_and_tests(experiment: Document) -> list[tuple[Document, str]]:
    """Every model with every test."""
    return [(model, test) for model in experiment["models"] for test in experiment["tests"]]


def is_synthetic(row: Document, experiment: Document) -> bool:
    """Return whether a row's condition has a set with its own labels."""
    words = row["condition"].split("+")
    return PERMUTED not in words and any(entry["name"] in words for entry in experiment["sets"])


def findings(experiment: Document) -> list[str]:
    """Return the findings: a sentence for every model, test and condition with synthetic images that is compared."""
    found = []
    for model, test in models_and_tests(experiment):
        for row in rows_of(experiment, model, test):
            if "against" in row and (is_synthetic(row, experiment) or PERMUTED in row["condition"].split("+")):
                score = f"{_title(MAIN[model['predicts']])} {row[MAIN[model['predicts']]]:.3f}"
                against = f"{title_of(row['against'], row['against_real'])} ({_difference(row)})"
                arm = f"{model['name']}, {test}: {title_of(row['condition'], row['real'])}"
                found.append(f"{arm}: {score}; {row['verdict']} against {against}")
    return found


def _difference(row: Document) -> str:
    """`+0.021, +0.003 to +0.040`."""
    ends = "" if row["difference_low"] is None else f", {row['difference_low']:+.3f} to {row['difference_high']:+.3f}"
    return f"{row['difference']:+.3f}{ends}"


def table_of(experiment: Document, model: Document, test: str) -> ResultTable:
    """All scores of a model on a test, means over folds; the main one with its interval and difference."""
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
    """A score's title; of a class `jaws IoU`."""
    name, _, score = metric.rpartition(".")
    return f"{name} {TITLES.get(score, score)}".strip()


def tables_of(experiment: Document) -> list[ResultTable]:
    """The table of every model and test."""
    return [table_of(experiment, model, test) for model, test in models_and_tests(experiment)]


def budget_text(experiment: Document) -> str:
    """Return the budget of every training and the number of seeds, in words."""
    models = [
        f"{model['name']}: {model['steps']} steps of {model['batch']} images of {model['input'][0]}x{model['input'][1]}"
        for model in experiment["models"]
    ]
    return f"{'; '.join(models)}; {counted(experiment['folds'], 'fold')}"


def summary_text(experiment: Document) -> str:
    """CSV with a line per arm and test, unrounded."""
    rows = experiment["summary"]
    return csv_text(list(dict.fromkeys(key for row in rows for key in row)), rows)


def write_tables(output: Path, experiment: Document) -> None:
    """Write downstream.csv and downstream.md into `output`."""
    title, lead = f"Downstream on {Path(experiment['capture']).name}", f"{budget_text(experiment)}."
    notes = [*experiment["findings"], *experiment["notes"], *failed_jobs(experiment)]
    write_text(output / "downstream.csv", summary_text(experiment))
    write_text(output / "downstream.md", markdown_document(title, lead, tables_of(experiment), "folds", notes))
