"""The tables of a downstream experiment: CSV for programs, Markdown for pages, LaTeX for papers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from neeco.experiments.downstream.results import MAIN, TITLES, metrics_of
from neeco.experiments.tables import (
    UNKNOWN,
    Cell,
    Column,
    Row,
    Table,
    csv_text,
    latex_lines,
    markdown_escape,
    markdown_lines,
)
from neeco.files import write_text

KEYS = ("taught with", "labelled")
DIFFERENCE_KEYS = ("taught with", "labelled", "against")
DIGITS = 3
DIFFERENCE_COLUMNS = (
    Column("difference", "difference", DIGITS),
    Column("low", "95 % from", DIGITS),
    Column("high", "to", DIGITS),
    Column("folds", "folds"),
)

Experiment = Mapping[str, Any]


def tables_of(experiment: Experiment) -> list[Table]:
    """For every model and split the scores of each condition, then the differences of its main score."""
    tables = []
    for model in experiment["models"]:
        for split in experiment["splits"]:
            tables.append(_scores(experiment, model, split))
            differences = _differences(experiment, model, split)
            tables += [differences] if differences.rows else []
    return tables


def _scores(experiment: Experiment, model: Mapping[str, Any], split: str) -> Table:
    name = model["name"]
    rows = [row for row in experiment["summary"] if (row["model"], row["split"]) == (name, split)]
    metrics = metrics_of([job for job in experiment["jobs"] if job["model"] == name], model["answers"])
    columns = tuple(
        Column(metric, title_of(metric), DIGITS, "high")
        for metric in metrics
        if any(row.get(metric, {}).get("n") for row in rows)
    )
    best = {column.key: _best(column, rows) for column in columns}
    made = []
    for row in sorted(rows, key=lambda row: (row["real"], _order(experiment, row["condition"]))):
        cells = tuple(_cell(column, row.get(column.key), best[column.key]) for column in columns)
        made.append(Row(_keys(row["condition"], row["real"]), cells, _failure(experiment, row)))
    return Table(f"{name}, split {split}", KEYS, columns, tuple(made))


def _differences(experiment: Experiment, model: Mapping[str, Any], split: str) -> Table:
    metric = MAIN[model["answers"]]
    wanted = (model["name"], split, metric)
    rows = [row for row in experiment["paired"] if (row["model"], row["split"], row["metric"]) == wanted]
    made = []
    for row in rows:
        cells = []
        for column in DIFFERENCE_COLUMNS:
            value = row[column.key]
            signed = column.key != "folds"
            cells.append(Cell(UNKNOWN if value is None else f"{value:+.{DIGITS}f}" if signed else str(value)))
        against = described(row["against"], row["against_real"])
        made.append(Row((*_keys(row["condition"], row["real"]), against), tuple(cells)))
    title = f"{model['name']}, split {split}: differences of {TITLES[metric]}"
    return Table(title, DIFFERENCE_KEYS, DIFFERENCE_COLUMNS, tuple(made))


def title_of(metric: str) -> str:
    """A score's title; of a class `jaws IoU`."""
    name, _, score = metric.rpartition(".")
    return f"{name} {TITLES[score]}" if name else TITLES[metric]


def described(condition: str, real: int) -> str:
    """`kinematic+real, 20 labelled`, in one line."""
    return f"{condition}, {real} labelled" if real else condition


def _keys(condition: str, real: int) -> tuple[str, str]:
    return condition, f"{real:,}" if real else "none"


def _order(experiment: Experiment, condition: str) -> int:
    known = list(dict.fromkeys(job["condition"] for job in experiment["jobs"]))
    return known.index(condition)


def _failure(experiment: Experiment, row: Mapping[str, Any]) -> str | None:
    """Why no fold of a row finished; None where one did."""
    keys = ("model", "condition", "real")
    same = [job for job in experiment["jobs"] if all(job[key] == row[key] for key in keys)]
    return same[0]["error"] if same and all("error" in job for job in same) else None


def _best(column: Column, rows: Sequence[Mapping[str, Any]]) -> str | None:
    """The best mean as it is written; None where all are alike."""
    means = [column.written(row[column.key]["mean"]) for row in rows if row.get(column.key, {}).get("n")]
    return max(means) if len(set(means)) > 1 else None


def _cell(column: Column, value: Mapping[str, Any] | None, best: str | None) -> Cell:
    if not value or not value["n"]:
        return Cell(UNKNOWN)
    mean = column.written(value["mean"])
    return Cell(mean, "" if value["std"] is None else column.written(value["std"]), mean == best)


def budget_words(experiment: Experiment) -> str:
    """What every training was given, and how often."""
    told = [
        f"{model['name']}: {model['steps']} steps of {model['batch']} images of {model['input'][0]}x{model['input'][1]}"
        for model in experiment["models"]
    ]
    folds = experiment["folds"]
    return f"{'; '.join(told)}; {folds} fold{'s' if folds > 1 else ''}"


def summary_csv(experiment: Experiment) -> str:
    """One line per model, condition, count of labelled frames and split, unrounded."""
    metrics = list(dict.fromkeys(key for row in experiment["summary"] for key in row if isinstance(row[key], dict)))
    header = ["model", "condition", "real", "split", "failed"]
    header += [f"{metric}_{part}" for metric in metrics for part in ("mean", "std", "n")]
    lines = [
        row | {f"{metric}_{part}": row[metric][part] for metric in metrics if metric in row for part in row[metric]}
        for row in experiment["summary"]
    ]
    return csv_text(header, lines)


def data_files(experiment: Experiment) -> dict[str, str]:
    """The CSV files of `data/` by name."""
    keys = ["model", "condition", "real", "fold"]
    scores = [
        {key: job[key] for key in keys} | {"split": split} | numbers
        for job in experiment["jobs"]
        for split, numbers in job["splits"].items()
    ]
    metrics = list(dict.fromkeys(key for row in scores for key in row if key not in (*keys, "split", "per_frame")))
    frames = [
        {key: row[key] for key in (*keys, "split")} | frame for row in scores for frame in row.get("per_frame", [])
    ]
    frame_metrics = list(dict.fromkeys(key for row in frames for key in row if key not in (*keys, "split", "frame")))
    jobs = [{**job, "seconds": job.get("seconds"), "error": job.get("error", "")} for job in experiment["jobs"]]
    courses = [
        {key: job[key] for key in keys} | {"step": step, "score": score}
        for job in experiment["jobs"]
        for step, score in job.get("validation", [])
    ]
    paired = ["model", "split", "metric", "condition", "real", "against", "against_real", "folds"]
    return {
        "scores.csv": csv_text([*keys, "split", *metrics], scores),
        "frames.csv": csv_text([*keys, "split", "frame", *frame_metrics], frames),
        "jobs.csv": csv_text([*keys, "iterations", "best_step", "seconds", "processor_seconds", "error"], jobs),
        "validation.csv": csv_text([*keys, "step", "score"], courses),
        "paired.csv": csv_text([*paired, "difference", "low", "high"], experiment["paired"]),
    }


def markdown_text(experiment: Experiment) -> str:
    """Markdown: the answers, then a table per model and split, their differences, and notes."""
    name = markdown_escape(Path(experiment["capture"]).name)
    parts = [f"# Downstream on {name}", "", markdown_escape(budget_words(experiment)) + ".", ""]
    parts += [f"- {markdown_escape(sentence)}" for sentence in experiment["answers"]] + [""]
    for table in tables_of(experiment):
        parts += [*markdown_lines(table), ""]
    parts += ["Mean ± standard deviation over folds; the best of a column is bold.", ""]
    parts += [f"- {markdown_escape(note)}" for note in experiment["notes"]]
    return "\n".join(parts).rstrip() + "\n"


def latex_text(experiment: Experiment) -> str:
    """LaTeX tables for the package booktabs."""
    parts = ["% \\usepackage{booktabs}"]
    name = Path(experiment["capture"]).name
    for table in tables_of(experiment):
        parts += ["", *latex_lines(table, f"{name}, {table.title}. {budget_words(experiment)}.")]
    parts += [""] + [f"% {' '.join(note.split())}" for note in experiment["notes"]]
    return "\n".join(parts).rstrip() + "\n"


def write_tables(output: Path, experiment: Experiment) -> None:
    """Write downstream.csv, .md and .tex, and data/*.csv behind them, into `output`."""
    write_text(output / "downstream.csv", summary_csv(experiment))
    write_text(output / "downstream.md", markdown_text(experiment))
    write_text(output / "downstream.tex", latex_text(experiment))
    for name, text in data_files(experiment).items():
        write_text(output / "data" / name, text)
