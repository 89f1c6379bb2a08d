"""Tables of the ablations: their rows, and their texts for the terminal, pages, CSV, Markdown and LaTeX."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from neeco.studies.tables import (
    UNKNOWN,
    Cell,
    Column,
    ResultTable,
    Row,
    csv_text,
    latex_table,
    markdown_table,
    write_files,
)

HEADINGS = {
    "phase_1_psnr": "phase-1 training PSNR",
    "psnr": "PSNR",
    "psnr_instrument": "instrument PSNR",
    "mask_iou": "mask IoU",
}

CSV_COLUMNS = ("table", "comparison", "setting", "run", "measure", "paper", "ours", "difference", "agrees")

Values = dict[str, float | None]  # by measure; empty where the run failed


@dataclass(frozen=True, kw_only=True)
class AblationRow:
    """One setting of a table: its numbers by measure, the paper's, and how both differ from the reference's."""

    comparison: str
    label: str
    reference: bool  # what the others of its comparison are measured against
    run: str
    values: Values
    paper: dict[str, float]
    paper_direction: str  # "worse" where the paper shows it in a figure without numbers
    difference: Values
    agrees: dict[str, str | None]  # of each judged measure: do ours and the paper's differ in the same direction


@dataclass(frozen=True, kw_only=True)
class AblationTable:
    """A table with its numbers. `judged`, `measures`: those compared with the paper, and all that are shown."""

    name: str
    group: str
    title: str
    question: str
    judged: list[str]
    measures: list[str]
    rows: list[AblationRow]
    curves: list[dict[str, Any]]  # held-out PSNR over the run: {comparison, label, iteration, progress, psnr}


def write_tables(output: Path, tables: Sequence[AblationTable]) -> None:
    """Write DIR/tables/NAME.csv, .md and .tex for every table."""
    for table in tables:
        texts = {"csv": ablation_csv(table), "md": markdown(table), "tex": latex_table(grid(table), table.title)}
        write_files(output / "tables", table.name, texts)


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


def grid(table: AblationTable) -> ResultTable:
    """A table for reading: per judged measure the paper's number, ours and whether they agree; the rest as ours alone.

    What is compared has a column of its own where it is not the same in all rows.
    """
    several = len({row.comparison for row in table.rows}) > 1
    columns = []
    for measure in table.measures:
        titles = [f"{heading(measure)}: paper", "ours", "agrees"] if measure in table.judged else [heading(measure)]
        columns += [Column(measure, title) for title in titles]
    rows = []
    for row in table.rows:
        cells = [text for measure in table.measures for text in _cells(row, measure, measure in table.judged)]
        keys = (row.comparison, row.label) if several else (row.label,)
        rows.append(Row(keys, tuple(map(Cell, cells)), reference=row.reference))
    return ResultTable(table.title, ("", "setting") if several else ("setting",), tuple(columns), tuple(rows))


def _cells(row: AblationRow, measure: str, judged: bool) -> list[str]:
    """Our number with its difference from the reference; where judged, after the paper's and before the verdict."""
    ours = formatted(measure, row.values.get(measure))
    if (difference := row.difference.get(measure)) is not None:
        ours += f" ({formatted(measure, difference, signed=True)})"
    if not judged:
        return [ours]
    paper = formatted(measure, row.paper.get(measure))
    agrees = "" if row.reference else row.agrees.get(measure) or UNKNOWN
    return [row.paper_direction if paper == UNKNOWN and row.paper_direction else paper, ours, agrees]


def agreement(table: AblationTable) -> str:
    """Return how many of the paper's directions ours shows, in words; "" for a table that judges nothing."""
    counts = Counter(agrees for row in table.rows for agrees in row.agrees.values())
    if not counts:
        return ""
    words = {"even": "even", "no": "the other way", None: "not known"}
    others = [f"{counts[key]} {text}" for key, text in words.items() if counts[key]]
    return ", ".join([f"{counts['yes']} of {counts.total()} as in the paper", *others])


def ablation_csv(table: AblationTable) -> str:
    """One line per setting and measure: every number in full."""
    rows = [
        {
            "table": table.name,
            "comparison": row.comparison,
            "setting": row.label,
            "run": row.run,
            "measure": measure,
            "paper": row.paper.get(measure),
            "ours": row.values.get(measure),
            "difference": row.difference.get(measure),
            "agrees": row.agrees.get(measure),
        }
        for row in table.rows
        for measure in dict.fromkeys([*table.measures, *row.values])
    ]
    return csv_text(CSV_COLUMNS, rows)


def markdown(table: AblationTable) -> str:
    """A Markdown table under its title."""
    title, empty, *lines = markdown_table(grid(table))
    directions = ["", f"Directions: {agreement(table)}."] if table.judged else []
    return "\n".join([title, empty, table.question, "", *lines, *directions]) + "\n"
