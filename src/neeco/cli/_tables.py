"""Tables for the terminal, cut between columns where they are wider than it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from rich.table import Column, Table
from rich.text import Text

if TYPE_CHECKING:
    from neeco.experiments.tables import Table as ResultTable

BORDER = 3  # what a column takes beside its text


def fitted(table: ResultTable, width: int) -> list[Table]:
    """A table in as many pieces as a terminal of `width` characters needs; the keys' columns stand in each.

    Bold are the best of a column, and a row that others are measured against; a row that failed says so in every piece.
    """
    headings, keys = [*table.keys, *(column.title for column in table.columns)], len(table.keys)
    rows = []
    for row in table.rows:
        cells = [Text(str(cell), "bold" if cell.best or row.reference else "") for cell in row.cells]
        told = cells if row.failed is None else [Text("failed", "red")]
        rows.append([*(Text(key, "bold" if row.reference else "") for key in row.keys), *told])
    return _pieces(table.title, headings, rows, keys, width)


def _pieces(title: str, headings: Sequence[str], rows: Sequence[Sequence[Text]], keys: int, width: int) -> list[Table]:
    """`fitted` of texts. A row of one cell behind its keys says the same in every piece."""
    full = [[*row[:keys], *[row[keys]] * (len(headings) - keys)] if len(row) == keys + 1 else row for row in rows]
    widths = [
        max([*map(len, heading.split()), *(len(row[index]) for row in full)], default=0)
        for index, heading in enumerate(headings)
    ]
    left = width - 1 - sum(BORDER + widths[index] for index in range(keys))
    groups: list[list[int]] = [[]]
    for index in range(keys, len(headings)):
        if groups[-1] and sum(BORDER + widths[i] for i in (*groups[-1], index)) > left:
            groups.append([])
        groups[-1].append(index)
    return [
        _piece(title if group is groups[0] else f"{title}, continued", headings, rows, keys, group, widths)
        for group in groups
    ]


def _piece(
    title: str,
    headings: Sequence[str],
    rows: Sequence[Sequence[Text]],
    keys: int,
    group: list[int],
    widths: Sequence[int],
) -> Table:
    """The columns of `group` behind the key columns, each as wide as its longest word."""
    whole = Text(title, "italic", no_wrap=True, overflow="ignore")
    table = Table(*(Column(headings[i], no_wrap=True) for i in range(keys)), title=whole, title_justify="left")
    for index in group:
        table.add_column(headings[index], justify="right", width=widths[index])
    for row in rows:
        table.add_row(*row[:keys], *(row[keys:] if len(row) == keys + 1 else [row[i] for i in group]))
    return table
