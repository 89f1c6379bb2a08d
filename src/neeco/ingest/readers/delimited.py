"""Delimited text: comma, semicolon, tab or blanks between the cells, in any usual encoding."""

from __future__ import annotations

import csv
import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from io import StringIO
from pathlib import Path

import numpy as np

from neeco.base.errors import NeecoError
from neeco.base.files import read_bytes
from neeco.capture.documents import printable
from neeco.ingest.readers import DELIMITED, MISSING, RecordingFormat, Table, parse_number
from neeco.ingest.readers.columns import UNITS, canonical_unit
from neeco.ingest.readers.ndi import find_tools

EXPECTED = "CSV with a header line"
MAX_COLUMNS = 4096
MAX_PADDING = 16  # of the cells of a text as a table over those that it holds
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
        text = read_cells(path)
        names, start = _header(path, text)
        used = ~text.comment & (np.arange(len(text.lines)) >= start)
        if not used.any():
            raise NeecoError(f"{path}: has a header but no rows; record again or name another file")
        header, rows = unique_names(names), text.cells[used, : len(names)]
        return Table(
            path, header, rows, text.lines[used], decimal_comma=text.decimal_comma, bodies=find_tools(header, rows)
        )


@dataclass(frozen=True, eq=False)
class Cells:
    """The lines of a text that hold anything. cells [N, W]: stripped, "" where a line has fewer; lines [N]: their
    numbers, from 1; counts [N]: of their own cells; comment [N]: are they behind a `#`, `//` or `% `, which is left
    out?; decimal_comma: commas in cells are those of decimals."""

    cells: np.ndarray
    lines: np.ndarray
    counts: np.ndarray
    comment: np.ndarray
    decimal_comma: bool

    def numeric(self, rows: np.ndarray | slice) -> np.ndarray:
        """Return which cells [R, W] of some lines hold numbers."""
        found = np.zeros(self.cells[rows].shape, dtype=bool)
        for place, cell in np.ndenumerate(self.cells[rows]):
            value = parse_number(cell.replace(",", ".") if self.decimal_comma else cell)
            found[place] = value is not None and cell.lower() not in MISSING
        return found


def read_cells(path: Path) -> Cells:
    """The lines of a text file that hold anything, of which one at least is no comment. Raises NeecoError."""
    import pandas

    texts = [(number, text) for number, text in enumerate(_read_text(path).splitlines(), 1) if text.strip(",;\t ")]
    comment = np.array([_COMMENT.match(text) is not None for _, text in texts], dtype=bool)
    if comment.all():
        raise NeecoError(f"{path}: holds only comments; expected {EXPECTED}")
    plain = [text for (_, text), is_comment in zip(texts, comment, strict=True) if not is_comment]
    sign = _delimiter(plain)
    lines = [_COMMENT.sub("", text) for _, text in texts]
    counts = np.array([len(line.split()) if sign == " " else line.count(sign) + 1 for line in lines])
    columns = range(int(counts.max()))
    if len(columns) > MAX_COLUMNS:
        line = texts[int(counts.argmax())][0]
        raise NeecoError(f"{path}: line {line}: has {len(columns)} cells; expected at most {MAX_COLUMNS}")
    if len(columns) * len(lines) > MAX_PADDING * int(counts.sum()) + 10**6:
        raise NeecoError(f"{path}: most lines are much shorter than the longest one; expected the rows of one table")
    is_open = any(line.count('"') % 2 for line in lines)  # a quote left open must not swallow the rest of the file
    try:
        frame = pandas.read_csv(
            StringIO("\n".join(lines)), sep=r"\s+" if sign == " " else sign, header=None, names=columns,
            index_col=False, dtype=str, na_filter=False, skip_blank_lines=False, low_memory=False,
            quoting=csv.QUOTE_NONE if is_open else csv.QUOTE_MINIMAL,
        )  # fmt: skip
    except (ValueError, OverflowError) as error:
        raise NeecoError(f"{path}: not readable as CSV ({' '.join(str(error).split())[:100]}); repair it") from None
    frame = frame.fillna("")  # where a line has fewer cells
    cells = np.empty(frame.size, object)
    cells[:] = [cell.strip(' \t"') for cell in frame.to_numpy(object).ravel().tolist()]
    commas = sign in ";\t" and any("," in text for text in plain[:49])
    rows = cells.reshape(frame.shape)
    return Cells(rows, np.array([number for number, _ in texts]), counts, comment, commas)


def unique_names(names: Sequence[str]) -> tuple[str, ...]:
    """Names of columns, of which the second of one name becomes `NAME#2`."""
    seen: Counter[str] = Counter()
    unique = []
    for name in names:
        seen[name] += 1
        unique.append(name if seen[name] == 1 or not name else f"{name}#{seen[name]}")
    return tuple(unique)


def _header(path: Path, text: Cells) -> tuple[list[str], int]:
    """The names of the columns, and the line from which the rows are. Raises NeecoError where nothing names them."""
    plain = np.flatnonzero(~text.comment).tolist()
    sample = plain[len(plain) // 2 :][:SAMPLE_LINES]
    numeric = np.flatnonzero(text.numeric(np.array(sample)).mean(axis=0) > 0.5)
    start = next((row for row in plain if _is_row(text, row, numeric)), None)
    if not len(numeric) or start is None:
        return _names(text, plain[0]), plain[0] + 1
    above = [int(row) for row in plain if row < start]
    places = [row for row in above if _names_columns(text, row, numeric)]
    if places:
        place, units = places[-1], [_unit_of(cell) for cell in text.cells[places[-1]]]
        filled = [unit for unit, cell in zip(units, text.cells[place], strict=True) if cell.strip("[]()- ")]
        before = next((row for row in reversed(above) if row < place), None)
        if before in places and sum(unit is not None for unit in filled) > 0.5 * len(filled) > 0:
            place, before = before, next((row for row in reversed(above) if row < before), None)
        else:
            units = [None] * len(units)
        names = _names(text, place)
        if before is not None:
            names = _grouped(names, text.cells[before])
        named = (f"{name} [{unit}]" if unit and name else name for name, unit in zip(names, units, strict=False))
        return list(named), places[-1] + 1
    if above and text.counts[above[-1]] == text.counts[start] and _names_columns(text, above[-1], np.array([0])):
        return _names(text, above[-1]), above[-1] + 1
    for row in reversed(np.flatnonzero(text.comment[:start]).tolist()):
        if text.counts[row] == text.counts[start] and _names_columns(text, row, numeric):
            return _names(text, row), start
    found, number = printable(",".join(_names(text, plain[0]))[:40]), text.lines[plain[0]]
    where = f"{path}: line {number}"
    if above:
        raise NeecoError(
            f"{where} is no header of columns (found {found}), and the rows of numbers begin at line "
            f"{text.lines[start]}; write a line that names the columns above that"
        )
    raise NeecoError(f"{where}: no header (found {found}); add a line naming the columns")


def _names(text: Cells, row: int) -> list[str]:
    return text.cells[row, : text.counts[row]].tolist()


def _is_row(text: Cells, row: int, numeric: np.ndarray) -> bool:
    """Return whether a line holds numbers, or a word for a missing one, wherever most do."""
    held = text.numeric(slice(row, row + 1))[0, numeric]
    missing = [index < text.counts[row] and text.cells[row, index].lower() in MISSING for index in numeric]
    return bool(held.any() and (held | missing).all())


def _names_columns(text: Cells, row: int, numeric: np.ndarray) -> bool:
    """Return whether a line has no numbers where the rows have them, and names for at least half of those columns."""
    named = sum(bool(cell) for cell in text.cells[row, numeric])
    return named >= 0.5 * len(numeric) and not text.numeric(slice(row, row + 1))[0, numeric].any()


def _unit_of(cell: str) -> str | None:
    unit = canonical_unit(cell.strip("[]() "))
    return unit if any(unit in units for units in UNITS.values()) else None


def _grouped(names: list[str], groups: Sequence[str]) -> list[str]:
    """Names of columns behind those of their groups, where these tell columns of one name apart."""
    joined, last = [], ""
    for name, group in zip(names, groups, strict=False):
        last = group or last
        joined.append("_".join(filter(None, (last, name))))
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
    if not text.strip() or any(character < " " and character not in "\t\r\n\f\v" for character in text[:4096]):
        raise NeecoError(f"{path}: {'not a text file' if text.strip() else 'the file is empty'}; expected {EXPECTED}")
    return text
