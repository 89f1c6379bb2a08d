"""The ablation tables as CSV, Markdown and LaTeX."""

from __future__ import annotations

import csv
import io
from collections import Counter
from pathlib import Path
from typing import Any, NamedTuple

from neeco.experiments.tables import latex_escape
from neeco.files import write_text

HEADINGS = {
    "phase_1_psnr": "phase-1 training PSNR",
    "psnr": "PSNR",
    "psnr_instrument": "instrument PSNR",
    "mask_iou": "mask IoU",
}
VERDICTS = {"yes": "yes", "no": "no", "even": "even", None: "-"}


class Grid(NamedTuple):
    """A table as text. The first `keys` columns say what a row is, the last of them its setting; numbers follow."""

    headings: list[str]
    rows: list[list[str]]
    keys: int


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
        return "-"
    digits = 3 if measure.startswith("mask_iou") else 2
    return f"{value:{'+' if signed else ''}.{digits}f}"


def grid(table: dict[str, Any]) -> Grid:
    """A table for reading: per judged measure the paper's number, ours and the verdict; the rest as ours alone.

    What is compared has a column of its own where it is not the same in all rows.
    """
    judged = table["judged"]
    several = len({row["comparison"] for row in table["rows"]}) > 1
    headings = ["", "setting"] if several else ["setting"]
    keys = len(headings)
    for measure in table["measures"]:
        headings += [f"{heading(measure)}: paper", "ours", "agrees"] if measure in judged else [heading(measure)]
    rows = []
    for row in table["rows"]:
        cells = [row["comparison"], row["label"]] if several else [row["label"]]
        for measure in table["measures"]:
            ours = _ours(row, measure)
            if measure not in judged:
                cells.append(ours)
                continue
            paper = row["paper"].get(measure)
            told = formatted(measure, paper) if paper is not None else row["paper_direction"] or "-"
            cells += [told, ours, "" if row["reference"] else VERDICTS[row["agrees"].get(measure)]]
        rows.append(cells)
    return Grid(headings, rows, keys)


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
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(["table", "comparison", "setting", "run", "measure", "paper", "ours", "difference", "agrees"])
    for row in table["rows"]:
        for measure in dict.fromkeys([*table["measures"], *row["values"]]):
            numbers = [row["paper"].get(measure), row["values"].get(measure), row["difference"].get(measure)]
            cells = ["" if number is None else number for number in numbers]
            verdict = row["agrees"].get(measure) or ""
            writer.writerow([table["name"], row["comparison"], row["label"], row["run"], measure, *cells, verdict])
    return stream.getvalue()


def markdown(table: dict[str, Any]) -> str:
    """A Markdown table under its title."""
    headings, rows, keys = grid(table)
    lines = [f"## {table['title']}", "", table["question"], ""]
    rule = "|" + "---|" * keys + "---:|" * (len(headings) - keys)
    lines += [_line(headings), rule, *map(_line, rows)]
    told = agreement(table)
    return "\n".join([*lines, *(["", f"Directions: {told}."] if told else [])]) + "\n"


def _line(cells: list[str]) -> str:
    return "| " + " | ".join(cells) + " |"


def latex(table: dict[str, Any]) -> str:
    """A LaTeX table (booktabs)."""
    headings, rows, keys = grid(table)
    lines = [r"\begin{table}", r"\centering", rf"\caption{{{latex_escape(table['title'])}}}"]
    lines += [rf"\begin{{tabular}}{{{'l' * keys}{'r' * (len(headings) - keys)}}}", r"\toprule"]
    lines += [_tex_row(headings), r"\midrule", *map(_tex_row, rows), r"\bottomrule"]
    return "\n".join([*lines, r"\end{tabular}", r"\end{table}"]) + "\n"


def _tex_row(cells: list[str]) -> str:
    return " & ".join(map(latex_escape, cells)) + r" \\"
