"""Exports of trackers with the columns of several bodies in a row: NDI's tools, each followed by its markers, and the
rigid bodies of `Table.bodies`."""

from __future__ import annotations

import re
from collections import Counter
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from neeco.capture.documents import printable
from neeco.errors import NeecoError
from neeco.ingest.readers import Table
from neeco.ingest.readers.columns import PoseColumns

_PORT = re.compile(r"port\b\s*(?P<port>[^:]*?)\s*(?::\s*(?P<name>.*))?$", re.IGNORECASE)
_NUMBERED = re.compile(r"#\d+$")  # what tells columns of one name apart
MARKERS = "markers"  # the column behind which those of a tool's markers begin


@dataclass(frozen=True)
class _Tool:
    """One tool's own columns, by their index in the header, and what it may be called."""

    columns: tuple[int, ...]
    title: str
    port: str
    name: str
    names: frozenset[str]


def tool_columns(table: Table, source: PoseColumns) -> Table:
    """The columns of the tool that `source` names, under their plain names, and those that stand before all tools; what
    is no export of several tools stays as it is.

    Raises NeecoError where there are several tools and none is named, or columns are named that are not all one tool's:
    the second `Tx` is the first tool's first marker.
    """
    tools = _tools(table)
    if not tools:
        if source.tool is not None:
            raise NeecoError(f"{table.path}: tool: there are no columns of tools or rigid bodies; leave it out")
        return table
    listed = ", ".join(tool.title for tool in tools)
    if source.tool is None and (source.position or source.rotation):
        _refuse_mixed(table, source, tools)
        return table
    wanted = None if source.tool is None else _canonical(source.tool)
    chosen = [tool for tool in tools if wanted is None or wanted in tool.names]
    if not chosen:
        raise NeecoError(f"{table.path}: tool: {printable(source.tool)} is none of them; name one of {listed}")
    if len(chosen) > 1:
        problem = (
            f"holds {len(tools)} tools" if wanted is None else f"{len(chosen)} tools go by {printable(source.tool)}"
        )
        raise NeecoError(f"{table.path}: {problem}; say which as `tool` in the recording: {listed}")
    table = replace(table, stream=chosen[0].name or chosen[0].port or None)  # which messages and notes name
    first = min(tool.columns[0] for tool in tools)
    columns = [*range(first), *chosen[0].columns]
    header = tuple(_NUMBERED.sub("", table.header[index]) for index in columns)
    if isinstance(table.rows, np.ndarray):
        return replace(table, header=header, rows=table.rows[:, columns])
    rows = [[cells[index] if index < len(cells) else "" for index in columns] for cells in table.rows]
    return replace(table, header=header, rows=rows)


def tool_names(table: Table) -> tuple[str, ...]:
    """Return a name for each tool of an export of several: its name or serial number, else its port; () for other
    tables, and for one tool without a name."""
    tools = _tools(table)
    if len(tools) < 2 and not table.bodies:
        return ()
    shared = Counter(name for tool in tools for name in tool.names)
    return tuple(
        next((word for word in (tool.name, tool.port) if word and shared[_canonical(word)] == 1), tool.title)
        for tool in tools
    )


def _tools(table: Table) -> list[_Tool]:
    if table.bodies or isinstance(table.rows, np.ndarray):
        return [
            _Tool(body.columns, printable(body.name), "", body.name, frozenset([_canonical(body.name)]))
            for body in table.bodies
        ]
    plain = [_NUMBERED.sub("", name).strip() for name in table.header]
    starts = [index for index, name in enumerate(plain) if _PORT.match(name)]
    found = []
    for start, end in pairwise([*starts, len(plain)]):
        own: list[int] = []
        seen: set[str] = set()
        for index in range(start, end):
            name = plain[index].lower()
            if name == MARKERS or name in seen:
                break
            seen.add(name)
            own.append(index)
        if {"q0", "tx"} <= seen:
            match = _PORT.match(plain[start])
            assert match is not None
            cell = next((cells[start] for cells in table.rows if start < len(cells) and cells[start]), "")
            words = [plain[start], match["port"], match["name"], cell]
            title = plain[start] if match["port"] or match["name"] else cell or plain[start]
            names = frozenset(_canonical(word) for word in words if word)
            found.append(_Tool(tuple(own), printable(title), match["port"] or cell, match["name"] or "", names))
    return found


def _refuse_mixed(table: Table, source: PoseColumns, tools: list[_Tool]) -> None:
    """Raise NeecoError where the columns that the recording names are not all one tool's own."""
    named = [*(source.position or ()), *(source.rotation or ()), *([source.state] if source.state else [])]
    places = {name: table.header.index(name) for name in named if name in table.header}
    owners = [next((tool.title for tool in tools if place in tool.columns), None) for place in places.values()]
    if None in owners:
        name = next(name for name, owner in zip(places, owners, strict=True) if owner is None)
        message = f"{name} is a marker's, no tool's"
    elif len(set(owners)) > 1:
        message = f"{', '.join(places)} are of several tools ({', '.join(dict.fromkeys(map(str, owners)))})"
    else:
        return
    raise NeecoError(f"{table.path}: columns: {message}; name the tool instead, as `tool` in the recording")


def _canonical(name: str) -> str:
    """A name in small letters; of a number, as ports have in several spellings, its value."""
    text = re.sub(r"^port\s*", "", name.strip().lower())
    try:
        return str(int(text, 16 if text.startswith("0x") else 10))
    except ValueError:
        return text
