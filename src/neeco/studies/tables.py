"""Result tables of every study: CSV by pandas, and one kind of table for the terminal, pages and Markdown.

`csv_text` writes rows of numbers in full. `summary_table` makes a `ResultTable` of means and standard deviations,
rounded, the best of each column marked; `markdown_document` writes several.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

UNKNOWN = "-"
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
        """`value` as the table shows it."""
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
    """The row's keys (as many as the table has), its cells, or the reason for their absence."""

    keys: tuple[str, ...]
    cells: tuple[Cell, ...]
    failed: str | None = None
    reference: bool = False  # what the others are measured against


@dataclass(frozen=True)
class ResultTable:
    """A titled table: `keys` heads the columns that say what a row is, the numbers' columns follow."""

    title: str
    keys: tuple[str, ...]
    columns: tuple[Column, ...]
    rows: tuple[Row, ...]


@dataclass(frozen=True)
class SummaryRow:
    """A row's keys, its numbers by column key as `study.spread` gives them, and the reason for their absence."""

    keys: tuple[str, ...]
    numbers: Mapping[str, Any]
    failed: str | None = None


def summary_table(
    title: str, keys: tuple[str, ...], columns: Sequence[Column], rows: Sequence[SummaryRow]
) -> ResultTable:
    """Mean ± standard deviation by row and column. Columns that no row has a number for are left out.

    The best mean of a column is judged as it is written, so that equal entries are all best; of one entry there is no
    best.
    """
    known = {column.key: [row.numbers[column.key] for row in rows if _has(row, column)] for column in columns}
    shown = tuple(column for column in columns if known[column.key])
    best = {}
    for column in shown:
        means = [numbers["mean"] for numbers in known[column.key]]
        if column.better is not None and len(means) > 1:
            best[column.key] = column.written(max(means) if column.better == "high" else min(means))

    def cell(row: SummaryRow, column: Column) -> Cell:
        if not _has(row, column):
            return Cell(UNKNOWN)
        numbers = row.numbers[column.key]
        mean = column.written(numbers["mean"])
        return Cell(
            mean, "" if numbers["std"] is None else column.written(numbers["std"]), mean == best.get(column.key)
        )

    made = (Row(row.keys, tuple(cell(row, column) for column in shown), row.failed) for row in rows)
    return ResultTable(title, keys, shown, tuple(made))


def _has(row: SummaryRow, column: Column) -> bool:
    return bool(row.numbers.get(column.key) and row.numbers[column.key]["n"])


def csv_text(columns: Sequence[str], rows: Iterable[Mapping[str, Any]]) -> str:
    """CSV with a header line, unrounded; None and what a row lacks are empty, what the columns lack is left out."""
    import pandas

    return str(
        pandas.DataFrame(list(rows), columns=list(columns), dtype=object).to_csv(index=False, lineterminator="\n")
    )


def markdown_table(table: ResultTable) -> list[str]:
    """The table's lines in Markdown under its title; the best of a column is bold."""
    headings = [markdown_escape(text) for text in (*table.keys, *(column.heading for column in table.columns))]
    rows = []
    for row in table.rows:
        cells = (
            [f"failed: {markdown_escape(row.failed)}", *[""] * (len(row.cells) - 1)] if row.failed is not None else []
        )
        for cell in () if cells else row.cells:
            text = markdown_escape(cell.text)
            cells.append((f"**{text}**" if cell.best else text) + (f" ± {cell.std}" if cell.std else ""))
        rows.append([*map(markdown_escape, row.keys), *cells])
    width = max(map(len, [headings, *rows]))  # no run has a number: the reasons have a column without heading
    headings += [""] * (width - len(headings))
    rule = "|" + "---|" * len(table.keys) + "---:|" * (len(headings) - len(table.keys))
    lines = [f"| {' | '.join(texts)} |" for texts in (headings, *rows)]
    return [f"## {markdown_escape(table.title)}", "", lines[0], rule, *lines[1:]]


def markdown_document(title: str, lead: str, tables: Sequence[ResultTable], over: str, notes: Sequence[str]) -> str:
    """Markdown: a heading, a sentence, the tables and notes. over: what their means are taken over."""
    parts = [f"# {markdown_escape(title)}", "", markdown_escape(lead), ""]
    for table in tables:
        parts += [*markdown_table(table), ""]
    parts += [f"Mean ± standard deviation over {over}; the best of a column is bold.", ""]
    parts += [f"- {markdown_escape(note)}" for note in notes]
    return "\n".join(parts).rstrip() + "\n"


def markdown_escape(text: str) -> str:
    """`text` so that Markdown shows it as it stands, in a table too."""
    for character in "\\|*_<`":
        text = text.replace(character, "\\" + character)
    return text
