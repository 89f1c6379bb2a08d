"""Tables cut to the terminal's width."""

from __future__ import annotations

import io

import pytest
from rich.console import Console

from neeco.cli._output import fitted
from neeco.studies.configurations import Cell, Column, ResultTable, Row


@pytest.mark.parametrize("width", [22, 60])
def test_a_failed_row_is_whole_in_every_piece_however_narrow_its_columns(width: int) -> None:
    numbers = tuple(map(Cell, ("12.00", "3", "4")))
    rows = Row(("a",), numbers), Row(("lost",), (Cell("-"),) * 3, failed="its loss became nan")
    table = ResultTable("t", ("method",), tuple(Column(title, title) for title in ("PSNR", "n", "m")), rows)
    console = Console(width=width, record=True, file=io.StringIO())
    pieces = fitted(table, width)
    for piece in pieces:
        console.print(piece)
    shown = console.export_text()
    assert shown.count("failed") == shown.count("lost") == len(pieces)
    assert all(number in shown for number in ("12.00", "3", "4"))
    assert "…" not in shown
    assert max(map(len, shown.splitlines())) <= width
    assert (len(pieces) > 1) == (width == 22)
