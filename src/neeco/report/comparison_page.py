"""The one-page report of a comparison: one file, offline, its figures' data inside it and beside it."""

from __future__ import annotations

import shlex
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from neeco.capture.model import Capture
from neeco.evaluation.difference import FULL_SCALE
from neeco.evaluation.mask_metrics import mean_of
from neeco.experiments.comparison import job_folder
from neeco.experiments.comparison_tables import (
    absent_notes,
    budget_words,
    data_files,
    machine_words,
    summary_csv,
    tables_of,
)
from neeco.experiments.summary import MASK_METRICS
from neeco.experiments.tables import UNKNOWN, Table, csv_text
from neeco.files import write_text
from neeco.report.charts import Series, binned, legend, line_chart
from neeco.report.comparison_shots import FrameRow, frame_rows
from neeco.report.page import REPORT_FILE, split_counts, write_page
from neeco.report.standings import standings

BINS = 6
DISTANCE_SCORES = (("psnr_instrument", "PSNR in the instrument, dB"), ("psnr", "PSNR, dB"), ("mask_iou", "label IoU"))
MINUTES_FROM = 180.0  # s; longer training is shown in minutes


def write_comparison_report(output: Path, comparison: dict[str, Any], capture: Capture) -> Path:
    """Write `report.html` and `data/*.csv` into `output`, the folder of a comparison, and return the page's path.

    comparison: what `compare` returned; the runs are taken from `output`. Every frame shown is drawn once per method.
    Raises NeecoError when a run cannot be opened, a picture not be read or the page not be written.
    """
    shots = [row for row in frame_rows(comparison, capture, output) if row.shots]
    files = {"summary.csv": summary_csv(comparison), "frames.csv": _frames_csv(shots), **data_files(comparison)}
    for name, text in files.items():
        write_text(output / "data" / name, text)
    return write_page(
        output / REPORT_FILE,
        "comparison.html",
        title=f"{capture.root.name}: methods compared",
        name=capture.root.name,
        subtitle="methods compared",
        version=comparison["version"],
        stamps=[machine_words(comparison)],
        methods=", ".join(_trained(comparison)) or "no method",
        trained=len(capture.split("train")),
        budget=budget_words(comparison),
        masks=", ".join(entry["name"] for entry in comparison["methods"] if entry["source"] != "train"),
        verdicts=_verdicts(comparison),
        tables=_tables(comparison),
        notes=absent_notes(comparison),
        shots=shots,
        full_scale=FULL_SCALE,
        files=files,
        **_curves(comparison),
        **_distance(comparison),
        **_speed(comparison),
        failed=[f"{job['name']}, seed {job['seed']}: {job['error']}" for job in comparison["jobs"] if "error" in job],
        facts=_facts(comparison, capture),
        configs=_configs(comparison, output),
    )


def _trained(comparison: Mapping[str, Any]) -> list[str]:
    return [entry["name"] for entry in comparison["methods"] if entry["source"] == "train"]


def _verdicts(comparison: Mapping[str, Any]) -> list[tuple[str, str]]:
    """(split or "", sentence) of what the numbers say."""
    verdicts = []
    if not comparison.get("complete", True):
        verdicts.append(("", "Not all runs are finished: these are the numbers so far."))
    for sentence in standings(comparison):
        split, _, rest = sentence.partition(": ")
        verdicts.append((split, rest) if rest and split in comparison["splits"] else ("", sentence))
    return verdicts


def _tables(comparison: Mapping[str, Any]) -> list[tuple[str, str, Table]]:
    """(title, split or "", table): of each the scores of images, and apart those of masks."""
    tables = []
    for table in tables_of(comparison):
        split = table.title.removeprefix("split ")
        for of_masks, title in ((False, table.title), (True, f"{table.title}: masks")):
            part = _part(table, of_masks)
            if part.columns:
                tables.append((title, split, part))
    return tables


def _part(table: Table, of_masks: bool) -> Table:
    """The table's scores of masks alone, or all others, with the methods that have a number in it."""
    kept = [k for k, column in enumerate(table.columns) if (column.key in MASK_METRICS) == of_masks]
    rows = [replace(row, cells=tuple(row.cells[k] for k in kept)) for row in table.rows]
    shown = [row for row in rows if row.failed is not None or any(cell.text != UNKNOWN for cell in row.cells)]
    return replace(table, columns=tuple(table.columns[k] for k in kept), rows=tuple(shown))


def _curves(comparison: Mapping[str, Any]) -> dict[str, Any]:
    """PSNR of held-out frames over training time, a chart per split."""
    names, curves = _trained(comparison), comparison["curves"]
    longest = max((row["seconds"] for row in curves), default=0.0)
    unit, scale = ("minutes", 1 / 60) if longest >= MINUTES_FROM else ("seconds", 1.0)
    clock = "processor " if comparison["budget"]["clock"] == "processor" else ""
    charts = []
    for split in dict.fromkeys(row["split"] for row in curves):
        series = []
        for order, name in enumerate(names):
            seeds: dict[int, list[tuple[float, float]]] = {}
            for row in curves:
                if (row["name"], row["split"]) == (name, split) and row["psnr"] is not None:
                    seeds.setdefault(row["seed"], []).append((row["seconds"] * scale, row["psnr"]))
            series.append(Series(name, order, *_mean_line(list(seeds.values()))))
        charts.append(line_chart(f"PSNR, {split}, dB", f"training time, {clock}{unit}", series))
    shown = [row["name"] for row in curves]
    return {"curves": [chart for chart in charts if chart], "curves_legend": legend(names, shown)}


def _mean_line(lines: list[list[tuple[float, float]]]) -> tuple[Any, Any]:
    """The line to read and the thin ones: the mean over seeds moment by moment, or the only seed itself."""
    lines = [sorted(line) for line in lines]
    if len(lines) < 2:
        return tuple(lines[0]) if lines else (), ()
    moments = min(map(len, lines))
    mean = tuple(
        (mean_of([line[k][0] for line in lines]), mean_of([line[k][1] for line in lines])) for k in range(moments)
    )
    return mean, tuple(map(tuple, lines))


def _distance(comparison: Mapping[str, Any]) -> dict[str, Any]:
    """Quality of every held-out frame against its distance from the nearest training state."""
    names = _trained(comparison)
    rows = [row for row in comparison["distance"] if row["distance"] is not None]
    charts = []
    for key, title in DISTANCE_SCORES:
        known = [row for row in rows if row[key] is not None]
        if not known:
            continue
        distances = np.array(sorted({row["distance"] for row in known}))
        edges = list(dict.fromkeys(np.quantile(distances, np.linspace(0, 1, BINS + 1)).tolist()))
        series = []
        for order, name in enumerate(names):
            frames: dict[tuple[str, float], list[float]] = {}
            for row in known:
                if row["name"] == name:
                    frames.setdefault((row["frame"], row["distance"]), []).append(row[key])
            dots = tuple((distance, mean_of(values)) for (_, distance), values in frames.items())
            series.append(Series(name, order, binned(dots, edges), dots=dots))
        charts.append(line_chart(title, "distance, standard deviations of the training states", series))
    shown = [row["name"] for row in rows]
    return {"distance": [chart for chart in charts if chart], "distance_legend": legend(names, shown), "bins": BINS}


def _speed(comparison: Mapping[str, Any]) -> dict[str, Any]:
    """Rows of the table of speeds, and how they were taken."""
    speed = comparison.get("speed") or {"rows": []}
    groups: dict[tuple[str, str], list[Mapping[str, Any]]] = {}
    for row in speed["rows"]:
        groups.setdefault((row["name"], row["backend"]), []).append(row)
    table = []
    for (name, backend), rows in groups.items():
        cells = [f"{statistics.median(row[key] for row in rows):,.1f}" for key in ("fps", "milliseconds")]
        counts = [row["num_gaussians"] for row in rows if row["num_gaussians"] is not None]
        table.append([name, backend, *cells, f"{statistics.median(counts):,.0f}" if counts else "–"])
    size = f", {speed['image'][0]}x{speed['image'][1]} pixels" if "image" in speed else ""
    told = f"{speed.get('how', '')}{size}; median over seeds. {machine_words(comparison)}."
    return {"speed": table, "speed_told": told}


def command_of(comparison: Mapping[str, Any]) -> str:
    """The command that makes this comparison."""
    budget = comparison["budget"]
    words = ["neeco", "compare", comparison["capture"], "--methods", *_trained(comparison)]
    words += ["--seeds", str(len(comparison["seeds"]))]
    if budget["iterations"] is not None:
        words += ["--iterations", str(budget["iterations"])]
    else:
        words += ["--processor-minutes" if budget["clock"] == "processor" else "--minutes", f"{budget['minutes']:g}"]
    words += ["--splits", *comparison["splits"]]
    if comparison["transforms"] != "transforms.json":
        words += ["--transforms", comparison["transforms"]]
    words += [word for setting in comparison["settings"] for word in ("--set", setting)]
    words += ["--output", "DIR"]
    masks = [f"{entry['name']}={entry['folder']}" for entry in comparison["methods"] if entry["source"] == "masks"]
    return shlex.join([*words, *(word for folder in masks for word in ("--masks", folder))])


def _facts(comparison: Mapping[str, Any], capture: Capture) -> list[tuple[str, str]]:
    machine = comparison["machine"]
    return [
        ("command", command_of(comparison)),
        ("capture", comparison["capture"]),
        ("frames", split_counts(capture)),
        ("budget", budget_words(comparison)),
        ("machine", machine_words(comparison)),
        ("versions", f"neeco {comparison['version']}, Python {machine['python']}, torch {machine['torch']}"),
        ("rasteriser", str(machine.get("backend", "–"))),
    ]


def _configs(comparison: Mapping[str, Any], output: Path) -> list[tuple[str, str]]:
    """(method, its config.yaml) of each method's first finished seed."""
    listings = []
    for name in _trained(comparison):
        seed = next((job["seed"] for job in comparison["jobs"] if job["name"] == name and "error" not in job), None)
        config = job_folder(output, name, seed) / "config.yaml" if seed is not None else None
        if config is not None and config.is_file():
            listings.append((name, config.read_text(encoding="utf-8", errors="replace")))
    return listings


def _frames_csv(rows: Sequence[FrameRow]) -> str:
    header = ["split", "frame", "name", "seed", "psnr"]
    return csv_text(header, [vars(shot) for row in rows for shot in row.shots])
