"""Delimited text: comma, semicolon, tab or blanks between the cells, in any usual encoding."""

from __future__ import annotations

import csv
import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from neeco.capture.documents import printable
from neeco.errors import NeecoError
from neeco.files import read_bytes
from neeco.ingest.readers import DELIMITED, MISSING, RecordingFormat, Table, parse_number
from neeco.ingest.readers.columns import UNITS, canonical_unit

EXPECTED = "CSV with a header line"
SAMPLE_LINES = 400  # that tell which columns hold numbers
_COMMENT = re.compile(r"^\s*(?:#+|//|%\s)\s*")


class DelimitedText(RecordingFormat):
    """CSV and its relatives. The header is the last line of names before the rows of numbers, or stands there behind a
    `#`; a line of units beneath it belongs to it. Columns of one name become `Tx`, `Tx#2`, `Tx#3`, or begin with what a
    line above the header calls each group of them."""

    format = "delimited text"
    holds = "poses or readings: CSV and its relatives with a header line, exports of NDI's trackers"
    suffixes = DELIMITED

    def read(self, path: Path, stream: str | None = None) -> Table:
        """Raises NeecoError when absent, empty, binary or without a header line."""
        if stream is not None:
            raise NeecoError(f"{path}: stream: a table is one; leave it out")
        lines = read_lines(path)
        names, rows = _header_and_rows(path, lines)
        if not rows:
            raise NeecoError(f"{path}: has a header but no rows; record again or name another file")
        cells = [line.cells for line in rows]
        numbers, comma = np.array([line.number for line in rows]), lines[0].decimal_comma
        return Table(path, unique_names(names), cells, numbers, decimal_comma=comma)


@dataclass(frozen=True)
class Line:
    """A line of a table that is not blank. number: in the file, from 1; cells: stripped; is_comment: behind a `#`, `//`
    or `% `, which is left out; decimal_comma: commas in its cells are those of decimals."""

    number: int
    cells: list[str]
    is_comment: bool
    decimal_comma: bool

    def number_at(self, column: int) -> bool:
        """Return whether a cell holds a number."""
        cell = self.cells[column] if column < len(self.cells) else ""
        value = parse_number(cell.replace(",", ".") if self.decimal_comma else cell)
        return value is not None and cell.lower() not in MISSING


def read_lines(path: Path) -> list[Line]:
    """The lines of a text file that hold anything, of which one at least is no comment. Raises NeecoError."""
    texts = [(number, text) for number, text in enumerate(_read_text(path).splitlines(), 1) if text.strip(",;\t ")]
    plain = [text for _, text in texts if not _COMMENT.match(text)]
    if not plain:
        raise NeecoError(f"{path}: holds only comments; expected {EXPECTED}")
    delimiter = _delimiter(plain)
    commas = delimiter in ";\t" and any("," in text for text in plain[:49])
    lines = []
    for number, text in texts:
        # one line is one row: a quote left open must not swallow the rest of the file
        mark = _COMMENT.match(text)
        lines.append(
            Line(number, _split(path, number, text[mark.end() if mark else 0 :], delimiter), bool(mark), commas)
        )
    return lines


def unique_names(names: Sequence[str]) -> tuple[str, ...]:
    """Names of columns, of which the second of one name becomes `NAME#2`."""
    seen: Counter[str] = Counter()
    unique = []
    for name in names:
        seen[name] += 1
        unique.append(name if seen[name] == 1 or not name else f"{name}#{seen[name]}")
    return tuple(unique)


def _header_and_rows(path: Path, lines: Sequence[Line]) -> tuple[list[str], list[Line]]:
    """The names of the columns, and the rows beneath them. Raises NeecoError where nothing names the columns."""
    plain = [line for line in lines if not line.is_comment]
    sample = plain[len(plain) // 2 :][:SAMPLE_LINES]
    width = max(len(line.cells) for line in sample)
    numeric = [i for i in range(width) if sum(line.number_at(i) for line in sample) > 0.5 * len(sample)]
    start = next((number for number, line in enumerate(plain) if _is_row(line, numeric)), None)
    if not numeric or start is None:
        return plain[0].cells, plain[1:]
    place = next((i for i in reversed(range(start)) if _names_columns(plain[i], numeric)), None)
    units: list[str] = []
    if place is not None and place > 0 and _are_units(plain[place].cells) and _names_columns(plain[place - 1], numeric):
        units, place = plain[place].cells, place - 1
    if place is None and start > 0 and len(plain[start - 1].cells) == len(plain[start].cells):
        place = start - 1 if plain[start - 1].cells[0] and not plain[start - 1].number_at(0) else None
    if place is not None:
        names = plain[place].cells
        if place > 0:
            names = _grouped(names, plain[place - 1].cells)
        known = [_unit_of(cell) for cell in units] + [None] * len(names)
        names = [f"{name} [{unit}]" if unit and name else name for name, unit in zip(names, known, strict=False)]
        return names, plain[place + (2 if units else 1) :]
    commented = [line for line in lines if line.is_comment and line.number < plain[start].number]
    for line in reversed(commented):
        if len(line.cells) == len(plain[start].cells) and _names_columns(line, numeric):
            return line.cells, plain[start:]
    found, number = printable(",".join(plain[0].cells)[:40]), plain[0].number
    if start > 0:
        raise NeecoError(
            f"{path}: line {number} is no header of columns (found {found}), and the rows of numbers begin at line "
            f"{plain[start].number}; write a line that names the columns above that"
        )
    raise NeecoError(f"{path}: line {number}: no header (found {found}); add a line naming the columns")


def _is_row(line: Line, numeric: Sequence[int]) -> bool:
    """Return whether a line holds numbers, or a word for a missing one, wherever most do."""
    held = [line.number_at(i) for i in numeric]
    return any(held) and all(
        is_number or (i < len(line.cells) and line.cells[i].lower() in MISSING)
        for i, is_number in zip(numeric, held, strict=True)
    )


def _names_columns(line: Line, numeric: Sequence[int]) -> bool:
    """Return whether a line has no numbers where the rows have them, and names for at least half of those columns."""
    named = sum(i < len(line.cells) and bool(line.cells[i]) for i in numeric)
    return named >= 0.5 * len(numeric) and not any(line.number_at(i) for i in numeric)


def _unit_of(cell: str) -> str | None:
    unit = canonical_unit(cell.strip("[]() "))
    return unit if any(unit in units for units in UNITS.values()) else None


def _are_units(cells: Sequence[str]) -> bool:
    filled = [cell for cell in cells if cell.strip("[]()- ")]
    return bool(filled) and sum(_unit_of(cell) is not None for cell in filled) > 0.5 * len(filled)


def _grouped(names: list[str], groups: Sequence[str]) -> list[str]:
    """Names of columns behind those of their groups, where these tell columns of one name apart."""
    filled, last = [], ""
    for index in range(len(names)):
        last = (groups[index] if index < len(groups) else "") or last
        filled.append(last)
    joined = ["_".join(part for part in pair if part) for pair in zip(filled, names, strict=True)]
    return joined if len(set(names)) < len(set(joined)) else names


def _delimiter(lines: Sequence[str]) -> str:
    """Return the sign between the cells of the rows, which are most of the second half of a file."""
    rows = lines[len(lines) // 2 :][:SAMPLE_LINES]
    for delimiter in "\t;":  # before commas, which may be those of decimals then
        count, n_similar = Counter(row.count(delimiter) for row in rows).most_common(1)[0]
        if count and n_similar > 0.9 * len(rows):
            return delimiter
    delimiter = max(",;\t", key=lambda sign: sum(row.count(sign) for row in rows))
    return delimiter if any(delimiter in row for row in rows) else " "


def _read_text(path: Path) -> str:
    """A text file in UTF-8, UTF-16 with its mark, or Latin-1."""
    content = read_bytes(path, EXPECTED)
    is_utf16 = content[:2] in (b"\xff\xfe", b"\xfe\xff")
    try:
        text = content.decode("utf-16" if is_utf16 else "utf-8-sig")
    except UnicodeDecodeError:
        text = "\0" if is_utf16 else content.decode("latin-1")
    if any(character < " " and character not in "\t\r\n\f\v" for character in text[:4096]):
        raise NeecoError(f"{path}: not a text file; expected {EXPECTED}")
    if not text.strip():
        raise NeecoError(f"{path}: the file is empty; expected {EXPECTED}")
    return text


def _split(path: Path, number: int, line: str, delimiter: str) -> list[str]:
    if delimiter == " ":
        return line.split()
    try:
        return [cell.strip() for cell in next(csv.reader([line], delimiter=delimiter), [])]
    except csv.Error as error:
        raise NeecoError(f"{path}: line {number}: not readable as CSV ({error}); repair or remove the line") from None
