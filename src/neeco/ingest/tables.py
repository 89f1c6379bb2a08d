"""Logger output as text tables: any usual delimiter and encoding, with the line every row came from."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from neeco.capture.documents import printable
from neeco.errors import NeecoError
from neeco.files import read_bytes

MISSING = {"", "nan", "na", "n/a", "null", "none", "missing", "oov", "-", "--"}
# NDI trackers write -3.697314e28 where there is no measurement; nothing a recording holds is this large
HUGE = 1e20
MAX_LISTED = 3  # rows named in a note
WRONG_ROWS = 0.05  # share of rows that may be wrong (not missing) before the file is refused


@dataclass(frozen=True)
class Table:
    """A text table. Columns of one name are told apart as `Tx`, `Tx#2`, `Tx#3`, from left to right."""

    path: Path
    header: tuple[str, ...]
    rows: list[list[str]]  # cells, stripped; as many as the file has, which may differ from the header's
    lines: np.ndarray  # int64 [R] the file's line of each row, from 1
    decimal_comma: bool = False

    def index(self, name: str) -> int | None:
        """The column called `name`, in any case of letters when only one is meant."""
        if name in self.header:
            return self.header.index(name)
        matches = [i for i, other in enumerate(self.header) if other.lower() == name.lower()]
        return matches[0] if len(matches) == 1 else None


class Rows:
    """Which rows of a table are in use; those left out, by reason, and those mended, for the notes."""

    def __init__(self, table: Table) -> None:
        self.table = table
        self.keep = np.ones(len(table.rows), dtype=bool)
        self.reasons: dict[str, list[int]] = {}  # the file's lines
        self.mended: list[str] = []  # other things done to the rows, in words

    def drop(self, which: np.ndarray | list[int], reason: str) -> None:
        """Leave rows out (bool [R], or their numbers), and note those that were in use."""
        lines = self.table.lines[which][self.keep[which]]
        if len(lines):
            self.reasons.setdefault(reason, []).extend(lines.tolist())
        self.keep[which] = False

    def drop_wrong(self, wrong: np.ndarray, reason: str) -> None:
        """Leave out a few rows that are wrong (bool [R]). Raises NeecoError when they are more than a few."""
        lines, count = self.table.lines[wrong & self.keep], int(self.keep.sum())
        if len(lines) > max(1, WRONG_ROWS * count):
            raise NeecoError(f"{self.table.path}: {listed(lines)} ({len(lines)} of {count_rows(count)}): {reason}")
        self.drop(wrong, reason.split(";")[0])

    def notes(self) -> tuple[str, ...]:
        name = self.table.path.name
        dropped = (
            f"{name}: {count_rows(len(lines))} dropped: {reason} ({listed(lines)})"
            for reason, lines in self.reasons.items()
        )
        return (*dropped, *(f"{name}: {what}" for what in self.mended))


def count_rows(count: int) -> str:
    return f"{count} row{'' if count == 1 else 's'}"


def listed(lines: Sequence[int] | np.ndarray) -> str:
    """`lines 3, 7, 9, ...`, the first few."""
    names = ", ".join(str(int(line)) for line in lines[:MAX_LISTED])
    return f"line{'' if len(lines) == 1 else 's'} {names}{', ...' if len(lines) > MAX_LISTED else ''}"


def read_text(path: Path) -> str:
    """A text file in UTF-8, UTF-16 with its mark, or Latin-1. Raises NeecoError when absent, empty or binary."""
    content = read_bytes(Path(path), "CSV with a header line")
    encodings = ["utf-16"] if content[:2] in (b"\xff\xfe", b"\xfe\xff") else ["utf-8-sig", "latin-1"]
    for encoding in encodings:
        try:
            text = content.decode(encoding)
            break
        except UnicodeDecodeError:
            continue
    else:
        raise NeecoError(f"{path}: not a text file; expected CSV with a header line")
    control = sum(character < " " and character not in "\t\r\n\f\v" for character in text[:4096])
    if control:
        raise NeecoError(f"{path}: not a text file; expected CSV with a header line")
    if not text.strip():
        raise NeecoError(f"{path}: the file is empty; expected CSV with a header line")
    return text


def read_table(path: Path) -> Table:
    """Read a table: comma, semicolon, tab or blanks between cells; lines that begin with # are skipped.

    Raises NeecoError when absent, empty, binary or without a header line.
    """
    path = Path(path)
    lines = [(number, line) for number, line in enumerate(read_text(path).splitlines(), 1) if _holds_data(line)]
    if not lines:
        raise NeecoError(f"{path}: holds only comments; expected CSV with a header line")
    delimiter = _delimiter(lines[0][1])
    # one line is one row: a quote left open must not swallow the rest of the file
    cells = [_split(path, number, line, delimiter) for number, line in lines]
    header = _unique(cells[0])
    if not any(header) or all(_is_number(name) for name in header if name):
        raise NeecoError(
            f"{path}: line {lines[0][0]}: no header (found {printable(lines[0][1][:40])}); "
            "add a first line naming the columns"
        )
    if len(lines) == 1:
        raise NeecoError(f"{path}: has a header but no rows; record again or name another file")
    comma = delimiter == ";" and any("," in cell for row in cells[1:50] for cell in row)
    return Table(path, header, cells[1:], np.array([number for number, _ in lines[1:]], dtype=np.int64), comma)


def numbers(table: Table, columns: Sequence[str]) -> tuple[np.ndarray, np.ndarray, list[tuple[int, str]]]:
    """Columns as numbers [R, C]; bool [R] rows where a value is missing; (row, what) for cells that are no numbers.

    Missing or unreadable cells are NaN. Raises NeecoError when a column does not exist.
    """
    indices = [column_index(table, name) for name in columns]
    values = np.full((len(table.rows), len(columns)), np.nan)
    missing = np.zeros(len(table.rows), dtype=bool)
    bad: list[tuple[int, str]] = []
    for row, cells in enumerate(table.rows):
        for slot, index in enumerate(indices):
            if index >= len(cells):
                bad.append((row, f"has {len(cells)} cells, the header {len(table.header)}"))
                break
            text = cells[index].replace(",", ".") if table.decimal_comma else cells[index]
            value = parse_number(text)
            if value is None:
                bad.append((row, f"{columns[slot]} is {printable(cells[index], 24)}, not a number"))
                break
            values[row, slot] = value
    missing |= np.isnan(values).any(axis=1)
    missing[[row for row, _ in bad]] = False
    return values, missing, bad


def column_index(table: Table, name: str) -> int:
    """The column called `name`. Raises NeecoError with the columns there are."""
    index = table.index(name)
    if index is None:
        names = ", ".join(table.header[:16]) + (", ..." if len(table.header) > 16 else "")
        raise NeecoError(f"{table.path}: has no column {printable(name)}; its columns are {printable(names, 200)}")
    return index


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


def _holds_data(line: str) -> bool:
    stripped = line.strip()
    return bool(stripped.strip(",;\t ")) and not stripped.startswith("#")


def _delimiter(header: str) -> str:
    counts = {delimiter: header.count(delimiter) for delimiter in (",", ";", "\t")}
    best = max(counts, key=lambda delimiter: counts[delimiter])
    return best if counts[best] else " "


def _split(path: Path, number: int, line: str, delimiter: str) -> list[str]:
    if delimiter == " ":
        return line.split()
    try:
        cells = next(csv.reader(io.StringIO(line), delimiter=delimiter), [])
    except csv.Error as error:
        raise NeecoError(f"{path}: line {number}: not readable as CSV ({error}); repair or remove the line") from None
    return [cell.strip() for cell in cells]


def _unique(names: Sequence[str]) -> tuple[str, ...]:
    seen: dict[str, int] = {}
    unique = []
    for name in names:
        seen[name] = seen.get(name, 0) + 1
        unique.append(name if seen[name] == 1 or not name else f"{name}#{seen[name]}")
    return tuple(unique)


def _is_number(text: str) -> bool:
    return parse_number(text) is not None
