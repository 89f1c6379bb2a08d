"""The page of `neeco ablate`: every table and figure in one file that opens offline."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from datetime import datetime
from html import escape
from pathlib import Path
from typing import Any

import neeco
from neeco.experiments.ablation_results import EVEN_DB, primary_split
from neeco.experiments.ablation_tables import agreement, csv_text, grid
from neeco.experiments.ablations import ABLATIONS
from neeco.experiments.families import PHASE_1_SHARE, PUBLISHED_STEPS
from neeco.files import write_text
from neeco.report.charts import Series, chart, download, legend
from neeco.report.style import CHART_STYLE, STYLE, html_page

WIDE = 9  # columns; with more a table is printed smaller

PAGE_STYLE = """
a { color: var(--accent); }
.setting { text-align: left; } td.yes { color: var(--good); } td.no { color: var(--bad); }
tr.reference td { font-weight: 650; } .figures { display: grid; gap: 14px; margin: 14px 0;
  grid-template-columns: repeat(auto-fill, minmax(min(100%, 340px), 1fr)); }
.figures figure > svg { width: 100%; height: auto; background: var(--card);
  border: 1px solid var(--edge); border-radius: 10px; }
.key { margin: 2px 0; } th { white-space: normal; min-width: 5em; }
@media print { th { min-width: 0; } .wide table { font-size: 6.5pt; } .wide th, .wide td { padding: 2px; } }
"""


def write_ablation_report(output: Path, ablation: dict[str, Any]) -> Path:
    """Write DIR/report.html from what `run_ablations` returned; its path."""
    name = Path(ablation["capture"]).name
    sections = [
        _header(name, ablation),
        _failures(ablation["failures"]),
        _notes(ablation["notes"]),
        _summary(ablation["tables"]),
    ]
    sections += [_section(table, ablation) for table in ablation["tables"]]
    sections.append(_runs(ablation))
    path = output / "report.html"
    write_text(path, html_page(f"{name}: ablations", STYLE + CHART_STYLE + PAGE_STYLE, sections))
    return path


def _header(name: str, ablation: dict[str, Any]) -> str:
    steps = " and ".join(f"{count:,} steps of {method}" for method, count in ablation["iterations"].items())
    extra = f", with {escape(', '.join(ablation['settings']))}" if ablation["settings"] else ""
    scaled = (
        f"The paper's schedule, stated for {PUBLISHED_STEPS:,} steps, is scaled to these runs, and phase 2 begins at "
        f"{PHASE_1_SHARE:.0%} of each; learning rates are not scaled. "
        if "neeco" in ablation["iterations"]
        else ""
    )
    return (
        f"<header><h1>{escape(name)} <span class='soft'>ablations</span></h1>"
        f"<p>What becomes of the result when one part is taken away or turned round. Runs have {steps}, "
        f"seed {ablation['seed']}{extra}. {scaled}In brackets: the difference to the line in bold.</p>"
        f"<p>One seed: a difference below {EVEN_DB} dB is called even, and one little above it may still be chance. "
        "The paper's numbers come from other recordings and longer runs; only directions are compared.</p>"
        f"<p class='soft'>{datetime.now().astimezone():%Y-%m-%d %H:%M %Z} · neeco {escape(neeco.__version__)}</p>"
        "</header>"
    )


def _failures(failures: Sequence[dict[str, str]]) -> str:
    if not failures:
        return ""
    rows = "".join(f"<li><b>{escape(item['run'])}</b>: {escape(item['error'])}</li>" for item in failures)
    return f"<h2>Not measured</h2><ul>{rows}</ul>"


def _notes(notes: Sequence[str]) -> str:
    return f"<ul class='note'>{''.join(f'<li>{escape(note)}</li>' for note in notes)}</ul>" if notes else ""


def _summary(tables: Sequence[dict[str, Any]]) -> str:
    """Do the paper's directions hold?"""
    judged = [table for table in tables if table["judged"]]
    rows = "".join(
        f"<tr><td><a href='#{table['name']}'>{escape(table['title'])}</a></td>"
        f"<td class='setting'>{escape(agreement(table))}</td></tr>"
        for table in judged
    )
    if not rows:
        return ""
    head = "<tr><th>table</th><th class='setting'>directions</th></tr>"
    return f"<h2>Do the paper's directions hold?</h2><div class='scroll'><table>{head}{rows}</table></div>"


def _section(table: dict[str, Any], ablation: dict[str, Any]) -> str:
    told = agreement(table)
    numbers = download(csv_text(table), f"{table['name']}.csv", "numbers of this table (CSV)")
    return (
        f"<section id='{table['name']}'><h2>{escape(table['title'])}</h2><p>{escape(table['question'])}</p>"
        f"{_table(table)}<p class='soft'>{escape(told) + ' ' if told else ''}{numbers}</p>"
        f"{_figures(table, ablation)}</section>"
    )


def _table(table: dict[str, Any]) -> str:
    headings, rows, keys = grid(table)
    setting = keys - 1
    marks = [" class='setting'" if index == setting else "" for index in range(len(headings))]
    head = "".join(f"<th{mark}>{escape(cell)}</th>" for mark, cell in zip(marks, headings, strict=True))
    body = []
    for row, cells in zip(table["rows"], rows, strict=True):
        marks = [f" class='{cell}'" if cell in ("yes", "no") else "" for cell in cells]
        marks[setting] = " class='setting'"
        told = "".join(f"<td{mark}>{escape(cell)}</td>" for mark, cell in zip(marks, cells, strict=True))
        opening = "<tr class='reference'>" if row["reference"] else "<tr>"
        body.append(f"{opening}{told}</tr>")
    kind = "scroll wide" if len(headings) > WIDE else "scroll"
    return f"<div class='{kind}'><table><thead><tr>{head}</tr></thead><tbody>{''.join(body)}</tbody></table></div>"


def _figures(table: dict[str, Any], ablation: dict[str, Any]) -> str:
    """Learning curves of the paper's tables; numbers over levels where a table has levels."""
    figures = [*_learning_curves(table, ablation), *_levels(table, ablation["splits"])]
    return f"<div class='figures'>{''.join(figures)}</div>" if figures else ""


def _learning_curves(table: dict[str, Any], ablation: dict[str, Any]) -> list[str]:
    """Held-out PSNR over steps, a figure for every comparison."""
    split = primary_split(tuple(ablation["splits"]))
    figures = []
    for comparison in dict.fromkeys(row["comparison"] for row in table["curves"]):
        rows = [row for row in table["curves"] if row["comparison"] == comparison]
        labels = list(dict.fromkeys(row["label"] for row in rows))
        known = [row for row in rows if row["psnr"] is not None]
        series = _series(labels, [(row["label"], row["iteration"], row["psnr"]) for row in known])
        phase_2 = (PHASE_1_SHARE * ablation["iterations"]["neeco"], "phase 2")
        drawn = chart(f"{comparison}: PSNR on {split}, dB", "steps", series, lines=[phase_2])
        data = [(r["label"], r["iteration"], r["psnr"]) for r in rows]
        words = "".join(letter if letter.isalnum() else "-" for letter in comparison)
        name = f"{table['name']}-{words}-curves.csv"
        figures.append(_figure(drawn, labels, series, _csv(("setting", "iteration", f"psnr_{split}"), data), name))
    return figures


def _levels(table: dict[str, Any], splits: Sequence[str]) -> list[str]:
    """PSNR and IoU over the entries of a table whose entries are amounts."""
    levels = ABLATIONS[table["name"]].levels
    if not levels:
        return []
    figures = []
    for score, title in (("psnr", "PSNR, dB"), ("psnr_instrument", "PSNR in the instrument, dB"), ("mask_iou", "IoU")):
        rows = [
            (split, level, row["values"].get(f"{score}.{split}"))
            for split in splits
            for level, row in zip(levels, table["rows"], strict=True)
        ]
        series = _series(splits, [(split, x, y) for split, x, y in rows if y is not None])
        drawn = chart(title, ABLATIONS[table["name"]].level_name, series)
        if drawn:
            data = _csv(("split", "level", score), rows)
            figures.append(_figure(drawn, splits, series, data, f"{table['name']}-{score}.csv"))
    return figures


def _series(names: Sequence[str], rows: Sequence[tuple[str, float, float]]) -> list[Series]:
    """A line with marks for each of `names` that has rows (name, x, y)."""
    found = []
    for order, name in enumerate(names):
        points = tuple((x, y) for label, x, y in rows if label == name)
        if points:
            found.append(Series(name, order, points, dots=points))
    return found


def _figure(drawn: str, names: Sequence[str], series: Sequence[Series], data: str, name: str) -> str:
    key = legend(names, [item.name for item in series])
    return f"<figure>{drawn}{key}<figcaption>{download(data, name, 'data (CSV)')}</figcaption></figure>"


def _csv(head: Sequence[str], rows: Sequence[Sequence[Any]]) -> str:
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerows([head, *rows])
    return stream.getvalue()


def _runs(ablation: dict[str, Any]) -> str:
    """How long every run took."""
    rows = [
        (run["name"], str(run["iterations"]), f"{run['seconds']:.0f}", f"{run['processor_seconds']:.0f}",
         f"{run['num_gaussians']:,}")
        for run in ablation["runs"]
    ]  # fmt: skip
    head = "".join(f"<th>{cell}</th>" for cell in ("run", "steps", "training s", "processor s", "Gaussians"))
    body = "".join("<tr>" + "".join(f"<td>{escape(cell)}</td>" for cell in row) + "</tr>" for row in rows)
    return f"<h2>Runs</h2><div class='scroll'><table><tr>{head}</tr>{body}</table></div>"
