"""Delimited text: comma, semicolon, tab or blanks between the cells, in any usual encoding."""

from __future__ import annotations

import csv
from collections import Counter
from pathlib import Path

import numpy as np

from neeco.capture.documents import printable
from neeco.errors import NeecoError
from neeco.files import read_bytes
from neeco.ingest.formats import DELIMITED, RecordingFormat, Table, parse_number

EXPECTED = "CSV with a header line"


class DelimitedText(RecordingFormat):
    """CSV and its relatives. Lines that begin with # are skipped; columns of one name become `Tx`, `Tx#2`, `Tx#3`."""

    format = "delimited text"
    holds = "poses or readings: CSV and its relatives with a header line, exports of NDI's trackers"
    suffixes = DELIMITED

    def read(self, path: Path, stream: str | None = None) -> Table:
        """Raises NeecoError when absent, empty, binary or without a header line."""
        if stream is not None:
            raise NeecoError(f"{path}: stream: a table is one; leave it out")
        lines = [(number, line) for number, line in enumerate(_read_text(path).splitlines(), 1) if _holds_data(line)]
        if not lines:
            raise NeecoError(f"{path}: holds only comments; expected {EXPECTED}")
        delimiter = max(",;\t", key=lines[0][1].count)
        if delimiter not in lines[0][1]:
            delimiter = " "
        # one line is one row: a quote left open must not swallow the rest of the file
        names, *rows = [_split(path, number, line, delimiter) for number, line in lines]
        header = _unique(names)
        if all(not name or parse_number(name) is not None for name in header):
            found = printable(lines[0][1][:40])
            raise NeecoError(f"{path}: line {lines[0][0]}: no header (found {found}); add a line naming the columns")
        if not rows:
            raise NeecoError(f"{path}: has a header but no rows; record again or name another file")
        decimal_comma = delimiter == ";" and any("," in cell for row in rows[:49] for cell in row)
        return Table(path, header, rows, np.array([number for number, _ in lines[1:]]), decimal_comma)


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


def _holds_data(line: str) -> bool:
    stripped = line.strip()
    return bool(stripped.strip(",;\t ")) and not stripped.startswith("#")


def _split(path: Path, number: int, line: str, delimiter: str) -> list[str]:
    if delimiter == " ":
        return line.split()
    try:
        return [cell.strip() for cell in next(csv.reader([line], delimiter=delimiter), [])]
    except csv.Error as error:
        raise NeecoError(f"{path}: line {number}: not readable as CSV ({error}); repair or remove the line") from None


def _unique(names: list[str]) -> tuple[str, ...]:
    seen: Counter[str] = Counter()
    unique = []
    for name in names:
        seen[name] += 1
        unique.append(name if seen[name] == 1 or not name else f"{name}#{seen[name]}")
    return tuple(unique)
