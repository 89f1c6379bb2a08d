"""Log files as tables: one module of this folder per file format.

A format is a subclass of `LogFormat`; `read_table` chooses it by the file's suffix, and nothing else names it. What the
columns mean is the same for all formats (`columns.py`, `logs.py`).
"""

from __future__ import annotations

import sys
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import ClassVar

import numpy as np

from neeco.capture.documents import printable
from neeco.errors import NeecoError
from neeco.registry import named_classes

MISSING = {"", "nan", "na", "n/a", "null", "none", "missing", "oov", "-", "--"}
# NDI trackers write -3.697314e28 where there is no measurement; nothing a recording holds is this large
HUGE = 1e20
MAX_LISTED = 3  # lines named in a message


@dataclass(frozen=True)
class Table:
    """What a log file holds. header: column names, all different."""

    path: Path
    header: tuple[str, ...]
    rows: list[list[str]]  # cells, stripped; a row may have more or fewer than the header
    lines: np.ndarray  # int64 [R] the file's line (or record) of each row, from 1
    decimal_comma: bool = False


class LogFormat(ABC):
    """A file format of logs. Subclasses set `format` and `suffixes` and have a constructor without arguments."""

    format: ClassVar[str]  # what the format is called
    suffixes: ClassVar[tuple[str, ...]]  # of its files, in small letters

    @abstractmethod
    def read(self, path: Path) -> Table:
        """The file as a table. Raises NeecoError naming the file, the place and the remedy."""


@cache
def log_formats() -> dict[str, LogFormat]:
    """The format for every file suffix that one reads."""
    kinds = named_classes(LogFormat, "format", sys.modules[__name__])  # type: ignore[type-abstract]
    return {suffix: kind() for kind in kinds.values() for suffix in kind.suffixes}


def read_table(path: Path) -> Table:
    """Read a log file; with a suffix that no format claims, as delimited text. Raises NeecoError."""
    formats = log_formats()
    return formats.get(Path(path).suffix.lower(), formats[".csv"]).read(Path(path))


def numbers(table: Table, columns: Sequence[str]) -> tuple[np.ndarray, np.ndarray, list[tuple[int, str]]]:
    """Columns as numbers [R, C]; bool [R] rows where a value is missing; (row, what) for cells that are no numbers.

    Missing or unreadable cells are NaN. Raises NeecoError when a column does not exist.
    """
    indices = [column_index(table, name) for name in columns]
    values = np.full((len(table.rows), len(columns)), np.nan)
    bad: list[tuple[int, str]] = []
    for row, cells in enumerate(table.rows):
        for slot, index in enumerate(indices):
            if index >= len(cells):
                bad.append((row, f"has {len(cells)} cells, the header {len(table.header)}"))
                break
            value = parse_number(cells[index].replace(",", ".") if table.decimal_comma else cells[index])
            if value is None:
                bad.append((row, f"{columns[slot]} is {printable(cells[index], 24)}, not a number"))
                break
            values[row, slot] = value
    missing = np.isnan(values).any(axis=1)
    missing[[row for row, _ in bad]] = False
    return values, missing, bad


def column_index(table: Table, name: str) -> int:
    """The column called `name`, in any case of letters when only one is meant. Raises NeecoError."""
    if name in table.header:
        return table.header.index(name)
    matches = [index for index, other in enumerate(table.header) if other.lower() == name.lower()]
    if len(matches) != 1:
        names = ", ".join(table.header[:16]) + (", ..." if len(table.header) > 16 else "")
        raise NeecoError(f"{table.path}: has no column {printable(name)}; its columns are {printable(names, 200)}")
    return matches[0]


def parse_number(text: str) -> float | None:
    """The number in a cell, NaN where the sample is missing, None where it is no number."""
    if text.lower() in MISSING:
        return np.nan
    if "_" in text:  # Python would read 1_000
        return None
    try:
        value = float(text)
    except ValueError:
        return None
    return value if abs(value) < HUGE else np.nan


def count_rows(count: int) -> str:
    """`1 row`, `12 rows`."""
    return f"{count} row{'' if count == 1 else 's'}"


def list_lines(lines: Sequence[int] | np.ndarray) -> str:
    """`lines 3, 7, 9, ...`, the first few."""
    names = ", ".join(str(int(line)) for line in lines[:MAX_LISTED])
    return f"line{'' if len(lines) == 1 else 's'} {names}{', ...' if len(lines) > MAX_LISTED else ''}"
