"""The ablation tables as CSV, Markdown and LaTeX."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Any

from neeco.experiments import tables
from neeco.experiments.tables import UNKNOWN, Cell, Column, Row, Table
from neeco.files import write_text

HEADINGS = {
    "phase_1_psnr": "phase-1 training PSNR",
    "psnr": "PSNR",
    "psnr_instrument": "instrument PSNR",
    "mask_iou": "mask IoU",
}
HEADER = ("table", "comparison", "setting", "run", "measure", "paper", "ours", "difference", "agrees")
VERDICTS = {"yes": "yes", "no": "no", "even": "even", None: UNKNOWN}


def write_tables(output: Path, ablation: dict[str, Any]) -> list[Path]:
    """Write DIR/tables/NAME.csv, .md and .tex for every table; the files written."""
    written = []
    for table in ablation["tables"]:
        texts = {"csv": csv_text(table), "md": markdown(table), "tex": latex(table)}
        for suffix, text in texts.items():
            path = output / "tables" / f"{table['name']}.{suffix}"
            write_text(path, text)
            written.append(path)
    return written


def heading(measure: str) -> str:
    """A measure in words, e.g. `test PSNR at 40 %`."""
    score, _, split = measure.partition(".")
    if score.startswith("psnr_at_"):
        return f"{split} PSNR at {score.removeprefix('psnr_at_')} %"
    return f"{split} {HEADINGS[score]}".strip()


def formatted(measure: str, value: float | None, *, signed: bool = False) -> str:
    """A number as the tables show it: dB with two digits, IoU with three; `-` when not known."""
    if value is None:
        return UNKNOWN
    digits = 3 if measure.startswith("mask_iou") else 2
    return f"{value:{'+' if signed else ''}.{digits}f}"


def grid(table: dict[str, Any]) -> Table:
    """A table for reading: per judged measure the paper's number, ours and the verdict; the rest as ours alone.

    What is compared has a column of its own where it is not the same in all rows.
    """
    judged = table["judged"]
    several = len({row["comparison"] for row in table["rows"]}) > 1
    columns = []
    for measure in table["measures"]:
        titles = [f"{heading(measure)}: paper", "ours", "agrees"] if measure in judged else [heading(measure)]
        columns += [Column(measure, title) for title in titles]
    rows = []
    for row in table["rows"]:
        keys = (row["comparison"], row["label"]) if several else (row["label"],)
        cells = [Cell(text) for measure in table["measures"] for text in _told(row, measure, measure in judged)]
        rows.append(Row(keys, tuple(cells), reference=row["reference"]))
    return Table(table["title"], ("", "setting") if several else ("setting",), tuple(columns), tuple(rows))


def _told(row: dict[str, Any], measure: str, judged: bool) -> list[str]:
    """Our number, and where it is judged the paper's before it and the verdict behind it."""
    if not judged:
        return [_ours(row, measure)]
    paper = row["paper"].get(measure)
    told = formatted(measure, paper) if paper is not None else row["paper_direction"] or UNKNOWN
    return [told, _ours(row, measure), "" if row["reference"] else VERDICTS[row["agrees"].get(measure)]]


def _ours(row: dict[str, Any], measure: str) -> str:
    """Our number, and in brackets how it differs from the reference's."""
    text = formatted(measure, row["values"].get(measure))
    difference = row["difference"].get(measure)
    return text if difference is None else f"{text} ({formatted(measure, difference, signed=True)})"


def agreement(table: dict[str, Any]) -> str:
    """How many of the paper's directions ours shows, in words; "" for a table that judges nothing."""
    verdicts = Counter(verdict for row in table["rows"] for verdict in row["agrees"].values())
    total = sum(verdicts.values())
    if not total:
        return ""
    words = [f"{verdicts['yes']} of {total} as in the paper"]
    words += [f"{verdicts['even']} even"] if verdicts["even"] else []
    words += [f"{verdicts['no']} the other way"] if verdicts["no"] else []
    words += [f"{verdicts[None]} not known"] if verdicts[None] else []
    return ", ".join(words)


def csv_text(table: dict[str, Any]) -> str:
    """One line per setting and measure: every number in full."""
    lines = []
    for row in table["rows"]:
        entry = {"table": table["name"], "setting": row["label"], **{key: row[key] for key in ("comparison", "run")}}
        for measure in dict.fromkeys([*table["measures"], *row["values"]]):
            numbers = {"paper": row["paper"], "ours": row["values"], **{k: row[k] for k in ("difference", "agrees")}}
            told = {column: values.get(measure) for column, values in numbers.items()}
            lines.append({**entry, "measure": measure, **told})
    return tables.csv_text(HEADER, lines)


def markdown(table: dict[str, Any]) -> str:
    """A Markdown table under its title."""
    title, empty, *lines = tables.markdown_lines(grid(table))
    told = agreement(table)
    directions = ["", f"Directions: {told}."] if told else []
    return "\n".join([title, empty, table["question"], "", *lines, *directions]) + "\n"


def latex(table: dict[str, Any]) -> str:
    """A LaTeX table (booktabs)."""
    return "\n".join(tables.latex_lines(grid(table), table["title"])) + "\n"
