"""Delimited text: comma, semicolon, tab or blanks between the cells, in any usual encoding.

Exports of trackers have the columns of several bodies in a row: NDI's tools, each followed by its markers.
"""

from __future__ import annotations

import csv
import re
from collections import Counter
from dataclasses import dataclass
from itertools import accumulate, pairwise
from pathlib import Path

import numpy as np

from neeco.base.errors import NeecoError
from neeco.base.files import read_bytes
from neeco.capture.documents import printable
from neeco.ingest.readers import DELIMITED, Kind, RecordingFormat, Stream, Table, read_once, to_numbers
from neeco.ingest.readers.names import TRACKER_CLOCK, UNITS, canonical_unit

EXPECTED = "CSV with a header line"
_COMMENT = re.compile(r"^\s*(?:#+|//|%\s)\s*")
_PORT = re.compile(r"port\b\s*(?P<port>[^:]*?)\s*(?::\s*(?P<name>.*))?$", re.IGNORECASE)
_NUMBERED = re.compile(r"#\d+$")  # suffix of repeated column names
MARKERS = "markers"  # column after which those of a tool's markers begin
_DECIMAL_COMMA = re.compile(r"[+-]?(?:\d+,\d*|,\d+)(?:[eE][+-]?\d+)?")


@dataclass(frozen=True, kw_only=True)
class TextLimits:
    """Limits on a text as a table."""

    columns: int = 4096
    padding: int = 16  # limit on the ratio of a table's cells to the cells with text
    sample_lines: int = 400  # lines examined for the columns of numbers
    header_lines: int = 1000  # lines among which the header is


LIMITS = TextLimits()


class DelimitedText(RecordingFormat):
    """CSV and similar text. The header is the last line of names before the rows of numbers, also behind a `#`; a line
    of units below it belongs to it. Repeated names become `Tx`, `Tx#2`, `Tx#3`, or get the group names of a line above
    the header as prefix."""

    format = "delimited text"
    holds = "poses or readings: CSV and similar text with a header line, exports of NDI's trackers"
    suffixes = DELIMITED

    def streams(self, path: Path) -> tuple[Stream, ...]:
        """Return the tools of an export of several tools; () for other tables."""
        *_, lines, tools = _parsed(path)
        return tuple(tool_stream(tool.name, len(lines)) for tool in tools) if len(tools) > 1 else ()

    def read(self, path: Path, stream: str | None = None) -> Table:
        """Return a table; for an NDI export the columns of one tool, under their plain names, and those before the
        first tool. Raises NeecoError if the file is missing, empty, binary or without a header line."""
        header, rows, lines, tools = _parsed(path)
        if not tools and stream is not None:
            raise NeecoError(f"{path}: stream: this table has no streams; remove `stream`")
        if not tools:
            return Table(path, header, rows, lines)
        alias = None if stream is None else _canonical(stream)
        tool_name = next((tool.name for tool in tools if alias in tool.aliases), stream)
        streams = [tool_stream(tool.name, len(lines)) for tool in tools]
        chosen = tools[streams.index(self.choose(path, tool_name, Kind.POSES, streams=streams))]
        columns = [*range(tools[0].columns.start), *chosen.columns]
        names = tuple(_NUMBERED.sub("", header[index]) for index in columns)
        return Table(path, names, rows[:, columns], lines, stream=chosen.name if len(tools) > 1 else None)


def tool_stream(name: str, count: int) -> Stream:
    """Return the stream of a tracker's tool or rigid body."""
    body = re.sub(r"[^A-Za-z0-9]+", "_", name).strip("_")
    body = body if body[:1].isalpha() else f"tool_{body}"
    return Stream(name, Kind.POSES, "tool", count, body=body, clock=TRACKER_CLOCK)


@read_once
def _parsed(path: Path) -> tuple[tuple[str, ...], np.ndarray, np.ndarray, tuple[_Tool, ...]]:
    """Return header, rows [R, C], their lines [R] and NDI's tools of a table. Raises NeecoError."""
    text = read_cells(path)
    names, start = _header(path, text)
    used = ~text.comment & (np.arange(len(text.lines)) >= start)
    if not used.any():
        raise NeecoError(f"{path}: has a header but no rows; record again or name another file")
    repeats = [names[:index].count(name) for index, name in enumerate(names)]
    unique = (f"{name}#{count + 1}" if name and count else name for name, count in zip(names, repeats, strict=True))
    header, rows = tuple(unique), text.cells[used, : len(names)]
    # NDI's tools: the columns of each from its `Port` to its markers, named by the first unique one of name, serial
    # number and port
    plain = [_NUMBERED.sub("", name).strip() for name in header]
    starts = [index for index, name in enumerate(plain) if _PORT.match(name)]
    tools: list[tuple[range, list[str]]] = []
    for first, end in pairwise([*starts, len(plain)]):
        lower = [name.lower() for name in plain[first:end]]
        length = next((n for n, name in enumerate(lower) if name == MARKERS or name in lower[:n]), len(lower))
        if {"q0", "tx"} <= set(lower[:length]):
            match, cell = _PORT.match(plain[first]), next(filter(None, rows[:, first]), "")
            port, name = (match["port"], match["name"] or "") if match else ("", "")
            words = [word for word in (name, port or cell, plain[first], cell) if word]
            tools.append((range(first, first + length), words))
    counts = Counter(word for _, words in tools for word in {_canonical(word) for word in words})
    distinct = [[word for word in words if counts[_canonical(word)] == 1] for _, words in tools]
    found = tuple(
        _Tool((words or [f"tool {number}"])[0], columns, frozenset(map(_canonical, words)))
        for number, ((columns, _), words) in enumerate(zip(tools, distinct, strict=True), 1)
    )
    return header, rows, text.lines[used], found


@dataclass(frozen=True, eq=False)
class Cells:
    """The non-empty lines of a text. cells [N, W]: stripped, "" where a line has fewer; lines [N]: their numbers, from
    1; counts [N]: number of cells per line; comment [N]: whether a line begins with `#`, `//` or `% `, which is
    removed."""

    cells: np.ndarray
    lines: np.ndarray
    counts: np.ndarray
    comment: np.ndarray

    def names(self, row: int) -> list[str]:
        """Return the cells of a line."""
        names: list[str] = self.cells[row, : self.counts[row]].tolist()
        return names


def read_cells(path: Path) -> Cells:
    """Return the non-empty lines of a text file in UTF-8, UTF-16 with a byte order mark, or Latin-1. Raises NeecoError
    if all are comments or the file is unreadable."""
    content = read_bytes(path, EXPECTED)
    is_utf16 = content[:2] in (b"\xff\xfe", b"\xfe\xff")
    try:
        whole = content.decode("utf-16" if is_utf16 else "utf-8-sig")
    except UnicodeDecodeError:
        whole = "\0" if is_utf16 else content.decode("latin-1")
    if not whole.strip() or any(character < " " and character not in "\t\r\n\f\v" for character in whole[:4096]):
        raise NeecoError(f"{path}: {'not a text file' if whole.strip() else 'the file is empty'}; expected {EXPECTED}")
    texts = [(number, text) for number, text in enumerate(whole.splitlines(), 1) if text.strip(",;\t ")]
    comment = np.array([_COMMENT.match(text) is not None for _, text in texts], dtype=bool)
    if comment.all():
        raise NeecoError(f"{path}: holds only comments; expected {EXPECTED}")
    # the delimiter of the rows, by the second half of the file
    plain = [text for (_, text), is_comment in zip(texts, comment, strict=True) if not is_comment]
    sample = plain[len(plain) // 2 :][: LIMITS.sample_lines]
    sign = max(",;\t", key=lambda sign: sum(row.count(sign) for row in sample))
    sign = sign if any(sign in row for row in sample) else " "
    for delimiter in ";\t":  # before commas, which may be those of decimals then
        count, n_similar = Counter(row.count(delimiter) for row in sample).most_common(1)[0]
        sign = delimiter if count and n_similar > 0.9 * len(sample) else sign
    lines = [_COMMENT.sub("", text) for _, text in texts]
    try:  # line by line: a quote left open must not swallow the rest of the file
        rows = [line.split() if sign == " " else next(csv.reader([line], delimiter=sign)) for line in lines]
    except csv.Error as error:
        raise NeecoError(f"{path}: cannot be read as CSV ({error}); repair it") from None
    counts = np.array([len(row) for row in rows])
    width = int(counts.max())
    if width > LIMITS.columns:
        line = texts[int(counts.argmax())][0]
        raise NeecoError(f"{path}: line {line}: has {width} cells; expected at most {LIMITS.columns}")
    if width * len(lines) > LIMITS.padding * int(counts.sum()) + 10**6:
        raise NeecoError(f"{path}: most lines are much shorter than the longest one; expected the rows of one table")
    commas = sign in ";\t"  # of decimals
    cells = np.full((len(rows), width), "", object)
    for filled, row in zip(cells, rows, strict=True):
        stripped = (cell.strip(' \t"') for cell in row)
        filled[: len(row)] = [
            cell.replace(",", ".") if commas and _DECIMAL_COMMA.fullmatch(cell) else cell for cell in stripped
        ]
    return Cells(cells, np.array([number for number, _ in texts]), counts, comment)


def _header(path: Path, text: Cells) -> tuple[list[str], int]:
    """Return the column names, and the first line of the rows. Raises NeecoError if there is no header line."""
    plain = np.flatnonzero(~text.comment)
    sample = plain[len(plain) // 2 :][: LIMITS.sample_lines]
    numeric = np.flatnonzero(np.isfinite(to_numbers(text.cells[sample])).mean(axis=0) > 0.5)
    head = text.cells[: LIMITS.header_lines, numeric]
    filled = np.isfinite(to_numbers(head))
    # lines that have no numbers where the rows have them, and names for at least half of those columns
    named = ((head != "").sum(axis=1) >= 0.5 * len(numeric)) & ~filled.any(axis=1)
    starts = [row for row in plain.tolist() if row < len(head) and filled[row].sum() > 0.5 * len(numeric)]
    if not starts:
        return text.names(plain[0]), plain[0] + 1
    above = plain[plain < starts[0]]
    places = above[named[above]].tolist()
    if places:
        place, higher = places[-1], above[above < places[-1]].tolist()
        units = [canonical_unit(cell.strip("[]() ")) for cell in text.cells[place]]
        units = [unit if any(unit in scales for scales in UNITS.values()) else "" for unit in units]
        stated = [unit for unit, cell in zip(units, text.cells[place], strict=True) if cell.strip("[]()- ")]
        if higher and higher[-1] in places and sum(map(bool, stated)) > 0.5 * len(stated) > 0:  # a line of units
            place = higher.pop()
        else:
            units = [""] * len(units)
        names = text.names(place)
        if higher:  # names of groups, where they distinguish repeated names
            groups = accumulate(text.cells[higher[-1]].tolist(), lambda last, group: str(group or last))
            joined = ["_".join(filter(None, pair)) for pair in zip(groups, names, strict=False)]
            names = joined if len(set(names)) < len(set(joined)) else names
        named_units = zip(names, units, strict=False)
        return [f"{name} [{unit}]" if unit and name else name for name, unit in named_units], places[-1] + 1
    for row in reversed(np.flatnonzero(text.comment[: starts[0]]).tolist()):
        if text.counts[row] == text.counts[starts[0]] and named[row]:
            return text.names(row), starts[0]
    first_cells, where = printable(",".join(text.names(plain[0]))[:40]), f"{path}: line {text.lines[plain[0]]}"
    rows = f", and the rows of numbers begin at line {text.lines[starts[0]]}" if len(above) else ""
    raise NeecoError(f"{where} is not a header line (found {first_cells}){rows}; add a line with the column names")


@dataclass(frozen=True)
class _Tool:
    """A tool of an NDI export. columns: by index; aliases: names that identify this tool alone."""

    name: str
    columns: range
    aliases: frozenset[str]


def _canonical(name: str) -> str:
    """Return a name in lower case; for a port number in any notation, its value."""
    text = re.sub(r"^port\s*", "", name.strip().lower())
    try:
        return str(int(text, 16 if text.startswith("0x") else 10))
    except ValueError:
        return text
