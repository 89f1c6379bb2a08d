"""Result tables of every study: CSV of numbers in full, and rounded tables for the terminal and pages."""

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


def summary_table(
    title: str, key: str, columns: Sequence[Column], rows: Sequence[tuple[str, Mapping[str, Any], str | None]]
) -> ResultTable:
    """Mean ± standard deviation by row (its key, its numbers by column as `study.spread` gives them, the reason for
    their absence) and column. Columns that no row has a number for are left out; means that are best as they are
    written are marked, where there are several."""
    used, best = [], {}
    for column in columns:
        means = [numbers[column.key]["mean"] for _, numbers, _ in rows if _has(numbers, column)]
        if means:
            used.append(column)
        if column.better is not None and len(means) > 1:
            best[column.key] = column.written(max(means) if column.better == "high" else min(means))

    def cell(numbers: Mapping[str, Any], column: Column) -> Cell:
        if not _has(numbers, column):
            return Cell(UNKNOWN)
        mean, std = (numbers[column.key][part] for part in ("mean", "std"))
        text = column.written(mean)
        return Cell(text, "" if std is None else column.written(std), text == best.get(column.key))

    made = (Row((name,), tuple(cell(numbers, column) for column in used), reason) for name, numbers, reason in rows)
    return ResultTable(title, (key,), tuple(used), tuple(made))


def _has(numbers: Mapping[str, Any], column: Column) -> bool:
    return bool(numbers.get(column.key) and numbers[column.key]["n"])


def csv_text(columns: Sequence[str], rows: Iterable[Mapping[str, Any]]) -> str:
    """CSV with a header line, unrounded; None and what a row lacks are empty, what the columns lack is left out."""
    import pandas

    table = pandas.DataFrame(list(rows), columns=list(columns), dtype=object)
    return str(table.to_csv(index=False, lineterminator="\n"))
