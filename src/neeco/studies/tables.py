"""Result tables of studies: CSV of unrounded numbers, and rounded tables for the terminal and pages."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

UNKNOWN = "-"
Better = Literal["high", "low", None]


@dataclass(frozen=True)
class Column:
    """One column of a table: its key in the results, title, format, and direction of improvement."""

    key: str
    title: str
    digits: int = 0
    better: Better = None
    scale: float = 1.0

    def written(self, value: float) -> str:
        """Return `value` formatted for the table."""
        return f"{value * self.scale:,.{self.digits}f}"

    @property
    def heading(self) -> str:
        """The title with an arrow in the direction of improvement."""
        return self.title + {"high": " ↑", "low": " ↓", None: ""}[self.better]


@dataclass(frozen=True)
class Cell:
    """One entry as text, its standard deviation if known, and whether it is the best of its column."""

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
    reference: bool = False  # whether the others are compared with it


@dataclass(frozen=True)
class ResultTable:
    """A table with a title: columns `keys` identify a row, columns of numbers follow."""

    title: str
    keys: tuple[str, ...]
    columns: tuple[Column, ...]
    rows: tuple[Row, ...]


def summary_table(
    title: str, key: str, columns: Sequence[Column], rows: Sequence[tuple[str, Mapping[str, Any], str | None]]
) -> ResultTable:
    """Return mean ± standard deviation by row (key, numbers by column from `study.spread`, reason of failure) and
    column. Columns without any number are left out; the best means, as displayed, are marked if there are several
    rows."""
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
    """Return CSV with a header line, unrounded; missing values are empty, other keys than the columns are ignored."""
    import pandas

    table = pandas.DataFrame(list(rows), columns=list(columns), dtype=object)
    return str(table.to_csv(index=False, lineterminator="\n"))
