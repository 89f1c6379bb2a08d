"""The one-page report of a comparison: one file, offline, its figures' data inside it and beside it."""

from __future__ import annotations

import shlex
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import replace
from datetime import datetime
from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from neeco.capture.model import Capture
from neeco.evaluation.mask_metrics import mean_of
from neeco.experiments.comparison import job_folder
from neeco.experiments.summary import MASK_METRICS
from neeco.experiments.tables import (
    UNKNOWN,
    Table,
    absent_notes,
    budget_words,
    csv_text,
    data_files,
    machine_words,
    rows_as_csv,
    tables_of,
)
from neeco.files import write_text
from neeco.report.charts import Series, binned, chart, download, legend
from neeco.report.comparison_shots import FrameRow, frame_rows, shots_html
from neeco.report.page import REPORT_FILE, SPLITS
from neeco.report.standings import standings
from neeco.report.style import CHART_STYLE, STYLE, html_page

BINS = 6
DISTANCE_SCORES = (("psnr_instrument", "PSNR in the instrument, dB"), ("psnr", "PSNR, dB"), ("mask_iou", "label IoU"))
MINUTES_FROM = 180.0  # s; longer training is shown in minutes
Rows = Sequence[Mapping[str, Any]]


def write_comparison_report(output: Path, comparison: dict[str, Any], capture: Capture) -> Path:
    """Write `report.html` and `data/*.csv` into `output`, the folder of a comparison, and return the page's path.

    comparison: what `compare` returned; the runs are taken from `output`. Every frame shown is drawn once per method.
    Raises NeecoError when a run cannot be opened, a picture not be read or the page not be written.
    """
    shots = frame_rows(comparison, capture, output)
    data = {"summary.csv": csv_text(comparison), "frames.csv": _frames_csv(shots), **data_files(comparison)}
    sections = [
        _header(comparison, capture),
        _standings(comparison),
        _tables(comparison, data),
        _with_data(shots_html(shots), data, "frames.csv"),
        _with_data(_curves(comparison), data, "curves.csv"),
        _with_data(_distance(comparison), data, "distance.csv"),
        _with_data(_speed(comparison), data, "speed.csv"),
        _failures(comparison),
        _made(comparison, capture, output),
    ]
    for name, text in data.items():
        write_text(output / "data" / name, text)
    path = output / REPORT_FILE
    write_text(path, html_page(f"{capture.root.name}: methods compared", STYLE + CHART_STYLE, sections))
    return path


def _with_data(section: str, data: Mapping[str, str], *names: str) -> str:
    if not section:
        return ""
    return section + f"<p class='soft'>{''.join(download(data[name], name) for name in names)}</p>"


def _trained(comparison: Mapping[str, Any]) -> list[str]:
    return [entry["name"] for entry in comparison["methods"] if entry["source"] == "train"]


def _header(comparison: Mapping[str, Any], capture: Capture) -> str:
    methods = ", ".join(_trained(comparison)) or "no method"
    others = [entry["name"] for entry in comparison["methods"] if entry["source"] != "train"]
    masks = f" Masks of {', '.join(others)} are scored beside theirs." if others else ""
    return (
        f"<header><h1>{escape(capture.root.name)} <span class='soft'>methods compared</span></h1>"
        f"<p>{escape(methods)}: trained on the same {len(capture.split('train'))} frames, "
        f"{escape(budget_words(comparison))}, and compared with photographs that none of them saw.{escape(masks)}</p>"
        f"<p class='soft'>{datetime.now().astimezone():%Y-%m-%d %H:%M %Z} · neeco {escape(comparison['version'])} · "
        f"{escape(machine_words(comparison))}</p></header>"
    )


def _standings(comparison: Mapping[str, Any]) -> str:
    sentences = standings(comparison)
    if not comparison.get("complete", True):
        sentences.insert(0, "Not all runs are finished: these are the numbers so far.")
    items = "".join(f"<li>{_bold_split(sentence, comparison['splits'])}</li>" for sentence in sentences)
    return f"<div class='verdict'><ul class='verdicts'>{items}</ul></div>" if items else ""


def _bold_split(sentence: str, splits: Sequence[str]) -> str:
    split, colon, rest = sentence.partition(": ")
    return f"<b>{escape(split)}</b>: {escape(rest)}" if colon and split in splits else escape(sentence)


def _tables(comparison: Mapping[str, Any], data: Mapping[str, str]) -> str:
    parts = ["<h2>Numbers</h2><p class='soft'>Mean ± standard deviation over seeds; the best is bold.</p>"]
    for table in tables_of(comparison):
        split = table.title.removeprefix("split ")
        meaning = f" <span class='soft'>{escape(SPLITS[split])}</span>" if split in SPLITS else ""
        images, masks = _parted(table)
        for part, title in ((images, table.title), (masks, f"{table.title}: masks")):
            if part.columns:
                parts.append(f"<h3>{escape(title)}{meaning}</h3>{_table(part)}")
    notes = "".join(f"<li>{escape(note)}</li>" for note in absent_notes(comparison))
    return _with_data("".join(parts), data, "summary.csv", "jobs.csv") + (
        f"<ul class='note'>{notes}</ul>" if notes else ""
    )


def _parted(table: Table) -> tuple[Table, Table]:
    """The table without the scores of masks, and those alone, each with the methods that have a number in it."""

    def chosen(of_masks: bool) -> Table:
        kept = [k for k, column in enumerate(table.columns) if (column.key in MASK_METRICS) == of_masks]
        rows = [(name, tuple(cells[k] for k in kept)) for name, cells in table.rows]
        shown = [row for row in rows if any(cell.mean != UNKNOWN for cell in row[1]) or row[0] in table.failed]
        return replace(table, columns=tuple(table.columns[k] for k in kept), rows=tuple(shown))

    return chosen(False), chosen(True)


def _table(table: Table) -> str:
    arrows = {"high": " ↑", "low": " ↓", None: ""}
    head = "".join(f"<th>{escape(column.title)}{arrows[column.better]}</th>" for column in table.columns)
    body = []
    for name, cells in table.rows:
        shown = "".join(
            f"<td{' class=best' if cell.best else ''}>{'–' if cell.mean == UNKNOWN else escape(cell.mean)}"
            f"{f' <small>± {escape(cell.std)}</small>' if cell.std else ''}</td>"
            for cell in cells
        )
        if name in table.failed:
            shown = f"<td class='failed' colspan='{len(cells)}'>failed: {escape(table.failed[name])}</td>"
        body.append(f"<tr><td>{escape(name)}</td>{shown}</tr>")
    return (
        f"<div class='scroll'><table><thead><tr><th>method</th>{head}</tr></thead>"
        f"<tbody>{''.join(body)}</tbody></table></div>"
    )


def _curves(comparison: Mapping[str, Any]) -> str:
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
        charts.append(chart(f"PSNR, {split}, dB", f"training time, {clock}{unit}", series))
    return _charts("PSNR over training time", charts, names, curves, "Bold: mean over seeds; thin: each seed.")


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


def _distance(comparison: Mapping[str, Any]) -> str:
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
        charts.append(chart(title, "distance, standard deviations of the training states", series))
    text = (
        f"Every held-out frame is a mark (mean over seeds); lines join the means of up to {BINS} groups of equal size. "
        "Distance is that from the nearest state trained on."
    )
    return _charts("Quality against distance from the training states", charts, names, rows, text)


def _charts(title: str, charts: Sequence[str], names: Sequence[str], rows: Rows, text: str) -> str:
    drawn = [item for item in charts if item]
    if not drawn:
        return ""
    key = legend(names, [row["name"] for row in rows])
    return f"<h2>{title}</h2><p class='soft'>{text}</p>{key}<div class='charts'>{''.join(drawn)}</div>"


def _speed(comparison: Mapping[str, Any]) -> str:
    speed = comparison.get("speed") or {"rows": []}
    groups: dict[tuple[str, str], list[Mapping[str, Any]]] = {}
    for row in speed["rows"]:
        groups.setdefault((row["name"], row["backend"]), []).append(row)
    if not groups:
        return ""
    body = []
    for (name, backend), rows in groups.items():
        cells = [backend]
        cells += [f"{statistics.median(row[key] for row in rows):,.1f}" for key in ("fps", "milliseconds")]
        counts = [row["num_gaussians"] for row in rows if row["num_gaussians"] is not None]
        cells.append(f"{statistics.median(counts):,.0f}" if counts else "–")
        body.append(f"<tr><td>{escape(name)}</td>{''.join(f'<td>{escape(cell)}</td>' for cell in cells)}</tr>")
    size = f", {speed['image'][0]}x{speed['image'][1]} pixels" if "image" in speed else ""
    return (
        f"<h2>Speed</h2><p class='soft'>{escape(speed.get('how', ''))}{size}; median over seeds. "
        f"{escape(machine_words(comparison))}.</p><div class='scroll'><table><thead><tr><th>method</th>"
        "<th>backend</th><th>FPS ↑</th><th>ms per image ↓</th><th>Gaussians</th></tr></thead>"
        f"<tbody>{''.join(body)}</tbody></table></div>"
    )


def _failures(comparison: Mapping[str, Any]) -> str:
    failed = [job for job in comparison["jobs"] if "error" in job]
    if not failed:
        return ""
    items = "".join(f"<li>{escape(job['name'])}, seed {job['seed']}: {escape(job['error'])}</li>" for job in failed)
    return f"<h2>What failed</h2><ul class='note'>{items}</ul>"


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


def _made(comparison: Mapping[str, Any], capture: Capture, output: Path) -> str:
    machine = comparison["machine"]
    splits = ", ".join(f"{len(capture.split(name))} {name}" for name in capture.splits)
    facts = [
        ("command", command_of(comparison)),
        ("capture", comparison["capture"]),
        ("frames", splits),
        ("budget", budget_words(comparison)),
        ("machine", machine_words(comparison)),
        ("versions", f"neeco {comparison['version']}, Python {machine['python']}, torch {machine['torch']}"),
        ("rasteriser", str(machine.get("backend", "–"))),
    ]
    items = "".join(f"<dt>{escape(name)}</dt><dd>{escape(value)}</dd>" for name, value in facts)
    listings = []
    for name in _trained(comparison):
        seed = next((job["seed"] for job in comparison["jobs"] if job["name"] == name and "error" not in job), None)
        config = job_folder(output, name, seed) / "config.yaml" if seed is not None else None
        if config is not None and config.is_file():
            text = config.read_text(encoding="utf-8", errors="replace")
            listings.append(
                f"<details><summary>{escape(name)}: config.yaml</summary><pre>{escape(text)}</pre></details>"
            )
    return f"<h2>How it was made</h2><dl class='made'>{items}</dl>{''.join(listings)}"


def _frames_csv(rows: Sequence[FrameRow]) -> str:
    shots = [shot for row in rows for shot in row.shots]
    header = ["split", "frame", "name", "seed", "psnr"]
    return rows_as_csv([{key: getattr(shot, key) for key in header} for shot in shots], header)
