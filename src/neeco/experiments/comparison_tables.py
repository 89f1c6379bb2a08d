"""The tables of a comparison: CSV for programs, Markdown for pages, LaTeX for papers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from neeco.experiments.machine import hardware_words
from neeco.experiments.summary import MASK_METRICS, RUN_METRICS, SPLIT_METRICS
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

METRICS = (*SPLIT_METRICS, *MASK_METRICS, *RUN_METRICS)
ABSENT = {
    "psnr_instrument": "the capture has no true masks, or no run finished",
    "mask_iou": "no method here carries labels, the capture has no true masks, or no run finished",
}
SPLIT_COLUMNS = (
    Column("psnr", "PSNR", 2, "high"),
    Column("ssim", "SSIM", 3, "high"),
    Column("lpips", "LPIPS", 3, "low"),
    Column("psnr_instrument", "PSNR instrument", 2, "high"),
    Column("mask_iou", "label IoU", 3, "high"),
)
MASK_COLUMNS = (
    Column("iou", "label IoU", 3, "high"),
    Column("challenge_iou", "Challenge IoU", 3, "high"),
    Column("challenge_iou_parts", "of parts", 3, "high"),
    Column("dice", "Dice", 3, "high"),
    Column("boundary_f", "boundary F", 3, "high"),
    Column("box_ap", "box AP", 3, "high"),
)
RUN_COLUMNS = (
    Column("iterations", "iterations"),
    Column("seconds", "minutes", 2, None, 1 / 60),
    Column("processor_seconds", "processor minutes", 2, None, 1 / 60),
    Column("fps", "FPS", 1, "high"),
    Column("num_gaussians", "Gaussians"),
    Column("peak_memory_mb", "peak MiB", 0, "low"),
)


def tables_of(comparison: Mapping[str, Any]) -> list[Table]:
    """One table per split, then the methods' own. Columns that nobody has a number for are left out."""
    failed = _failed(comparison)
    tables = []
    for split in comparison["splits"]:
        rows = [row for row in comparison["summary"] if row["split"] == split]
        scored = any(row["iou"]["n"] for row in rows)  # the same number, for other people's masks too
        ours = [column for column in SPLIT_COLUMNS if not (scored and column.key == "mask_iou")]
        tables.append(_table(f"split {split}", (*ours, *MASK_COLUMNS), rows, failed))
    trained = {entry["name"] for entry in comparison["methods"] if entry["source"] == "train"}
    first = comparison["splits"][0]
    rows = [row for row in comparison["summary"] if row["split"] == first and row["name"] in trained]
    tables.append(_table("training and drawing", RUN_COLUMNS, rows, failed))
    return tables


def absent_notes(comparison: Mapping[str, Any]) -> list[str]:
    """What the tables lack, and why."""
    notes = list(comparison["notes"])
    for column in SPLIT_COLUMNS:
        values = [row[column.key]["n"] for row in comparison["summary"]]
        if not any(values) and not any(note.startswith(column.key) for note in notes):
            notes.append(f"{column.key}: nobody has it: {ABSENT.get(column.key, 'no run finished')}")
    if not any(row["seconds"]["std"] is not None for row in comparison["summary"]):
        notes.append("no ± is given: one seed has no standard deviation; give --seeds 2 or more")
    return notes


def _failed(comparison: Mapping[str, Any]) -> dict[str, str]:
    """Methods of which no seed finished, with the first reason."""
    finished = {job["name"] for job in comparison["jobs"] if "error" not in job}
    reasons: dict[str, str] = {}
    for job in comparison["jobs"]:
        if "error" in job and job["name"] not in finished:
            reasons.setdefault(job["name"], job["error"])
    return reasons


def _table(title: str, columns: Sequence[Column], rows: Sequence[dict[str, Any]], failed: Mapping[str, str]) -> Table:
    kept = tuple(column for column in columns if any(row[column.key]["n"] for row in rows))
    best = {column.key: _best(column, rows) for column in kept}
    made = []
    for row in rows:
        cells = tuple(_cell(column, row[column.key], best[column.key]) for column in kept)
        made.append(Row((row["name"],), cells, failed.get(row["name"])))
    return Table(title, ("method",), kept, tuple(made))


def _best(column: Column, rows: Sequence[Mapping[str, Any]]) -> str | None:
    """The best mean as it is written, so that equal entries are all best; None when there is nothing to choose."""
    means = [row[column.key]["mean"] for row in rows if row[column.key]["n"]]
    if column.better is None or len(means) < 2:
        return None
    return column.written(max(means) if column.better == "high" else min(means))


def _cell(column: Column, value: Mapping[str, Any], best: str | None) -> Cell:
    if not value["n"]:
        return Cell(UNKNOWN)
    mean = column.written(value["mean"])
    std = "" if value["std"] is None else column.written(value["std"])
    return Cell(mean, std, mean == best)


def summary_csv(comparison: Mapping[str, Any]) -> str:
    """One line per method and split, unrounded; unknown numbers are empty."""
    header = ["name", "split", "failed"]
    header += [f"{metric}_{part}" for metric in METRICS for part in ("mean", "std", "n")]
    lines = [row | {f"{m}_{part}": row[m][part] for m in METRICS for part in row[m]} for row in comparison["summary"]]
    return csv_text(header, lines)


def budget_words(comparison: Mapping[str, Any]) -> str:
    """What every run was given, and how often."""
    from neeco.experiments.training_job import Budget

    seeds = len(comparison["seeds"])
    return f"{Budget(**comparison['budget'])} each, {seeds} seed{'s' if seeds > 1 else ''}"


def machine_words(comparison: Mapping[str, Any]) -> str:
    """The machine that the numbers were taken on."""
    machine = comparison["machine"]
    threads = machine["threads_per_worker"] or machine["threads"]
    workers = f", {machine['workers']} at once" if machine["workers"] > 1 else ""
    drawing = f"{threads} drawing thread{'s' if threads > 1 else ''}"
    return f"{hardware_words(machine)}, {drawing}{workers}, torch {machine['torch']}"


def markdown_text(comparison: Mapping[str, Any]) -> str:
    """Markdown: a heading, one table per split, the methods' own, and what is absent."""
    told = f"{budget_words(comparison)}. {markdown_escape(machine_words(comparison))}."
    parts = [f"# Comparison on {markdown_escape(Path(comparison['capture']).name)}", "", told, ""]
    for table in tables_of(comparison):
        parts += [*markdown_lines(table), ""]
    parts += ["Mean ± standard deviation over seeds; the best of a column is bold.", ""]
    parts += [f"- {markdown_escape(note)}" for note in absent_notes(comparison)]
    return "\n".join(parts).rstrip() + "\n"


def latex_text(comparison: Mapping[str, Any]) -> str:
    """LaTeX tables for the package booktabs, one per split and one of the methods' own."""
    parts = ["% \\usepackage{booktabs}", f"% {_one_line(machine_words(comparison))}"]
    name = Path(comparison["capture"]).name
    for table in tables_of(comparison):
        parts += ["", *latex_lines(table, f"{name}, {table.title}. {budget_words(comparison)}.")]
    parts += [""] + [f"% {_one_line(note)}" for note in absent_notes(comparison)]
    return "\n".join(parts).rstrip() + "\n"


def _one_line(text: str) -> str:
    return " ".join(text.split())


def write_tables(output: Path, comparison: Mapping[str, Any]) -> None:
    """Write comparison.csv, .md and .tex, and data/*.csv behind them, into `output`."""
    write_text(output / "comparison.csv", summary_csv(comparison))
    write_text(output / "comparison.md", markdown_text(comparison))
    write_text(output / "comparison.tex", latex_text(comparison))
    for name, text in data_files(comparison).items():
        write_text(output / "data" / name, text)


def data_files(comparison: Mapping[str, Any]) -> dict[str, str]:
    """The CSV files of `data/` by name: every run's numbers, and what the figures are drawn from."""
    job_header = ["name", "method", "seed", "split", *SPLIT_METRICS, "frames", *RUN_METRICS, "error"]
    jobs = [
        {**job, **numbers, "split": split}
        for job in comparison["jobs"]
        for split, numbers in (job["splits"] or {"": {}}).items()
    ]
    distance_header = ["name", "seed", "split", "frame", "distance", "psnr", "psnr_instrument", "mask_iou"]
    speed_header = ["name", "seed", "method", "backend", "fps", "milliseconds", "draws", "num_gaussians"]
    return {
        "jobs.csv": csv_text(job_header, jobs),
        "curves.csv": csv_text(["name", "seed", "seconds", "iteration", "split", "psnr"], comparison["curves"]),
        "distance.csv": csv_text(distance_header, comparison["distance"]),
        "speed.csv": csv_text(speed_header, comparison["speed"]["rows"]),
    }
