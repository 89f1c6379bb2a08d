"""One kind of result table, for the terminal, pages, Markdown and LaTeX; and the CSV of numbers behind it."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

UNKNOWN = "-"
LATEX_SPECIAL = {
    "\\": r"\textbackslash{}",
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    **{character: "\\" + character for character in "&%$#_{}"},
    "±": r"$\pm$",
    "<": r"\textless{}",
    ">": r"\textgreater{}",
    "|": r"\textbar{}",
}
Better = Literal["high", "low", None]


@dataclass(frozen=True)
class Column:
    """One number of a table: its key among the results, its title, how it is written, and which way is better."""

    key: str
    title: str
    digits: int = 0
    better: Better = None
    scale: float = 1.0

    def written(self, value: float) -> str:
        return f"{value * self.scale:,.{self.digits}f}"

    @property
    def heading(self) -> str:
        """The title with an arrow that says which way is better."""
        return self.title + {"high": " ↑", "low": " ↓", None: ""}[self.better]


@dataclass(frozen=True)
class Cell:
    """One entry as text, ± its standard deviation where known, and whether it is the best of its column."""

    text: str
    std: str = ""
    best: bool = False

    def __str__(self) -> str:
        return f"{self.text} ± {self.std}" if self.std else self.text


@dataclass(frozen=True)
class Row:
    """What the row is of (as many keys as the table has), its cells, or why there are none."""

    keys: tuple[str, ...]
    cells: tuple[Cell, ...]
    failed: str | None = None
    reference: bool = False  # what the others are measured against


@dataclass(frozen=True)
class Table:
    """A titled table: `keys` heads the columns that say what a row is, the numbers' columns follow."""

    title: str
    keys: tuple[str, ...]
    columns: tuple[Column, ...]
    rows: tuple[Row, ...]


def csv_text(header: Sequence[str], rows: Sequence[Mapping[str, Any]]) -> str:
    """CSV with a header line, unrounded; None and what a row lacks are empty, what the header lacks is left out."""
    stream = io.StringIO()
    writer = csv.DictWriter(stream, header, extrasaction="ignore", lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return stream.getvalue()


def markdown_lines(table: Table) -> list[str]:
    """The table in Markdown under its title; the best of a column is bold."""

    def line(cells: Sequence[str]) -> str:
        return f"| {' | '.join(cells)} |"

    headings = [*table.keys, *(column.heading for column in table.columns)]
    lines = [f"## {markdown_escape(table.title)}", "", line([markdown_escape(heading) for heading in headings])]
    lines.append("|" + "---|" * len(table.keys) + "---:|" * len(table.columns))
    for row in table.rows:
        shown = [f"**{cell.text}**" + str(cell)[len(cell.text) :] if cell.best else str(cell) for cell in row.cells]
        if row.failed is not None:
            shown = [f"failed: {markdown_escape(row.failed)}"] + [""] * (len(row.cells) - 1)
        lines.append(line([*map(markdown_escape, row.keys), *shown]))
    return lines


def markdown_escape(text: str) -> str:
    """`text` so that Markdown shows it as it stands, in a table too."""
    return text.replace("\\", "\\\\").replace("|", "\\|").replace("*", "\\*").replace("_", "\\_")


def latex_lines(table: Table, caption: str) -> list[str]:
    """The table in LaTeX for the package booktabs; the best of a column is bold."""
    arrows = {"high": r" $\uparrow$", "low": r" $\downarrow$", None: ""}
    headings = [latex_escape(key.capitalize()) for key in table.keys]
    headings += [latex_escape(column.title) + arrows[column.better] for column in table.columns]
    lines = [r"\begin{table}", r"\centering", rf"\caption{{{latex_escape(caption)}}}"]
    lines += [rf"\begin{{tabular}}{{{'l' * len(table.keys)}{'r' * len(table.columns)}}}", r"\toprule"]
    lines += [" & ".join(headings) + r" \\", r"\midrule"]
    for row in table.rows:
        shown = [_latex_cell(cell) for cell in row.cells]
        if row.failed is not None:
            shown = [rf"\multicolumn{{{max(len(row.cells), 1)}}}{{l}}{{{latex_escape(f'failed: {row.failed}')}}}"]
        lines.append(" & ".join([*map(latex_escape, row.keys), *shown]) + r" \\")
    return [*lines, r"\bottomrule", r"\end{tabular}", r"\end{table}"]


def latex_escape(text: str) -> str:
    """`text` so that LaTeX prints it as it stands."""
    return "".join(LATEX_SPECIAL.get(character, character) for character in text)


def _latex_cell(cell: Cell) -> str:
    if cell.text == UNKNOWN:
        return "--"
    text = rf"\textbf{{{cell.text}}}" if cell.best else latex_escape(cell.text)
    return rf"{text} $\pm$ {cell.std}" if cell.std else text
