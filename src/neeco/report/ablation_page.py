"""The page of `neeco ablate`: every table and figure in one file that opens offline."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from neeco.experiments.ablation_results import EVEN_DB, primary_split
from neeco.experiments.ablation_tables import agreement, csv_text, grid
from neeco.experiments.ablations import ABLATIONS
from neeco.experiments.families import NEECO_RUNS, PHASE_1_SHARE, PUBLISHED_STEPS
from neeco.experiments.machine import hardware_words
from neeco.experiments.tables import csv_text as csv_of
from neeco.report.charts import Series, legend, line_chart
from neeco.report.page import REPORT_FILE, write_page

LEVEL_SCORES = (("psnr", "PSNR, dB"), ("psnr_instrument", "PSNR in the instrument, dB"), ("mask_iou", "IoU"))
Figure = dict[str, Any]  # chart, legend, data (a CSV) and file (its name)


def write_ablation_report(output: Path, ablation: dict[str, Any]) -> Path:
    """Write DIR/report.html from what `run_ablations` returned; its path."""
    name = Path(ablation["capture"]).name
    steps = " and ".join(f"{count:,} steps of {method}" for method, count in ablation["iterations"].items())
    return write_page(
        output / REPORT_FILE,
        "ablation.html",
        title=f"{name}: ablations",
        name=name,
        subtitle="ablations",
        steps=steps + f", seed {ablation['seed']}",
        hardware=hardware_words(ablation["machine"]),
        settings=", ".join(ablation["settings"]),
        scaled=NEECO_RUNS.method in ablation["iterations"],
        published=f"{PUBLISHED_STEPS:,}",
        phase_1=f"{PHASE_1_SHARE:.0%}",
        even=EVEN_DB,
        failures=[(item["run"], item["error"]) for item in ablation["failures"]],
        notes=ablation["notes"],
        tables=[_table(table, ablation) for table in ablation["tables"]],
        runs=[_run(run) for run in ablation["runs"]],
    )


def _table(table: dict[str, Any], ablation: dict[str, Any]) -> dict[str, Any]:
    """Learning curves belong to the paper's tables; numbers over levels where a table has levels."""
    return {
        **{key: table[key] for key in ("name", "title", "question", "judged")},
        "told": agreement(table),
        "grid": grid(table),
        "data": csv_text(table),
        "figures": [*_learning_curves(table, ablation), *_levels(table, ablation["splits"])],
    }


def _learning_curves(table: dict[str, Any], ablation: dict[str, Any]) -> list[Figure]:
    """Held-out PSNR over steps, a figure for every comparison."""
    split = primary_split(tuple(ablation["splits"]))
    figures = []
    for comparison in dict.fromkeys(row["comparison"] for row in table["curves"]):
        rows = [row for row in table["curves"] if row["comparison"] == comparison]
        labels = list(dict.fromkeys(row["label"] for row in rows))
        series = _series(labels, [(row["label"], row["iteration"], row["psnr"]) for row in rows])
        phase_2 = (PHASE_1_SHARE * ablation["iterations"][NEECO_RUNS.method], "phase 2")
        drawn = line_chart(f"{comparison}: PSNR on {split}, dB", "steps", series, starts=[phase_2])
        data = [{"setting": r["label"], "iteration": r["iteration"], f"psnr_{split}": r["psnr"]} for r in rows]
        words = "".join(letter if letter.isalnum() else "-" for letter in comparison)
        figures.append(_figure(drawn, labels, series, data, f"{table['name']}-{words}-curves.csv"))
    return figures


def _levels(table: dict[str, Any], splits: Sequence[str]) -> list[Figure]:
    """PSNR and IoU over the entries of a table whose entries are amounts."""
    levels, over = ABLATIONS[table["name"]].levels, ABLATIONS[table["name"]].level_name
    figures = []
    for score, title in LEVEL_SCORES if levels else ():
        rows = [
            (split, level, row["values"].get(f"{score}.{split}"))
            for split in splits
            for level, row in zip(levels, table["rows"], strict=True)
        ]
        series = _series(splits, rows)
        drawn = line_chart(title, over, series)
        if drawn:
            data = [{"split": split, "level": level, score: value} for split, level, value in rows]
            figures.append(_figure(drawn, splits, series, data, f"{table['name']}-{score}.csv"))
    return figures


def _series(names: Sequence[str], rows: Sequence[tuple[str, float, float | None]]) -> list[Series]:
    """A line with marks for each of `names` that has rows (name, x, y) with a y."""
    found = []
    for order, name in enumerate(names):
        points = tuple((x, y) for label, x, y in rows if label == name and y is not None)
        if points:
            found.append(Series(name, order, points, dots=points))
    return found


def _figure(
    drawn: str, names: Sequence[str], series: Sequence[Series], rows: Sequence[dict[str, Any]], file: str
) -> Figure:
    shown = legend(names, [item.name for item in series])
    return {"chart": drawn, "legend": shown, "data": csv_of(list(rows[0]), rows), "file": file}


def _run(run: dict[str, Any]) -> list[str]:
    """How long a run took."""
    times = [f"{run['seconds']:.0f}", f"{run['processor_seconds']:.0f}"]
    return [run["name"], str(run["iterations"]), *times, f"{run['num_gaussians']:,}"]
