"""Exports of trackers with the columns of several bodies in a row: NDI's tools, each followed by its markers, and the
rigid bodies of other formats."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np

from neeco.base.errors import NeecoError
from neeco.capture.documents import printable
from neeco.ingest.readers import Body, Table
from neeco.ingest.readers.columns import PoseColumns

_PORT = re.compile(r"port\b\s*(?P<port>[^:]*?)\s*(?::\s*(?P<name>.*))?$", re.IGNORECASE)
_NUMBERED = re.compile(r"#\d+$")  # what tells columns of one name apart
MARKERS = "markers"  # the column behind which those of a tool's markers begin


def find_tools(header: Sequence[str], rows: np.ndarray) -> tuple[Body, ...]:
    """Return NDI's tools: the columns of each from its `Port` to its markers; named by name or serial number, else by
    port, where that is no other's."""
    plain = [_NUMBERED.sub("", name).strip() for name in header]
    starts = [index for index, name in enumerate(plain) if _PORT.match(name)]
    found: list[tuple[range, str, list[str]]] = []
    for start, end in pairwise([*starts, len(plain)]):
        names = [name.lower() for name in plain[start:end]]
        own = next((n for n, name in enumerate(names) if name == MARKERS or name in names[:n]), len(names))
        if {"q0", "tx"} <= set(names[:own]):
            match, cell = _PORT.match(plain[start]), next(filter(None, rows[:, start]), "")
            port, name = (match["port"], match["name"] or "") if match else ("", "")
            title = plain[start] if port or name else cell or plain[start]
            found.append((range(start, start + own), title, [name, port or cell, plain[start], cell]))
    shared = Counter(word for _, _, words in found for word in {_canonical(word) for word in words if word})
    return tuple(
        Body(
            next((word for word in words[:2] if word and shared[_canonical(word)] == 1), printable(title)),
            tuple(columns), title=printable(title), aliases=frozenset(_canonical(word) for word in words if word),
        )
        for columns, title, words in found
    )  # fmt: skip


def tool_columns(table: Table, source: PoseColumns) -> Table:
    """The columns of the tool that `source` names, under their plain names, and those that stand before all tools; what
    is no export of several tools stays as it is.

    Raises NeecoError where there are several tools and none is named, or columns are named that are not all one tool's:
    the second `Tx` is the first tool's first marker.
    """
    if not table.bodies:
        if source.tool is not None:
            raise NeecoError(f"{table.path}: tool: there are no columns of tools or rigid bodies; leave it out")
        return table
    if source.tool is None and (source.position or source.rotation):
        _refuse_mixed(table, source)
        return table
    wanted = None if source.tool is None else _canonical(source.tool)
    chosen = [body for body in table.bodies if wanted is None or wanted in {_canonical(body.name), *body.aliases}]
    if len(chosen) != 1:
        listed = ", ".join(body.title or printable(body.name) for body in table.bodies)
        count, given = len(chosen) or "none", printable(source.tool)
        problem = f"holds {len(table.bodies)} tools" if wanted is None else f"tool: {given} is {count} of them"
        raise NeecoError(f"{table.path}: {problem}; say which as `tool` in the recording: {listed}")
    columns = [*range(min(body.columns[0] for body in table.bodies)), *chosen[0].columns]
    header = tuple(_NUMBERED.sub("", table.header[index]) for index in columns)
    return replace(table, header=header, rows=table.rows[:, columns], stream=chosen[0].name, bodies=())


def tool_names(table: Table) -> tuple[str, ...]:
    """Return the name of each body of an export of several; () for other tables, and for NDI's with one tool."""
    single = len(table.bodies) == 1 and table.bodies[0].aliases
    return () if single else tuple(body.name for body in table.bodies)


def _refuse_mixed(table: Table, source: PoseColumns) -> None:
    """Raise NeecoError where the columns that the recording names are not all one tool's own."""
    named = [*(source.position or ()), *(source.rotation or ()), *([source.state] if source.state else [])]
    places = {name: table.header.index(name) for name in named if name in table.header}
    owners = {name: [body.name for body in table.bodies if place in body.columns] for name, place in places.items()}
    strangers = [name for name, own in owners.items() if not own]
    if strangers or len({own[0] for own in owners.values()}) > 1:
        what = f"{strangers[0]} is a marker's, no tool's" if strangers else f"{', '.join(places)} are of several tools"
        raise NeecoError(f"{table.path}: columns: {what}; name the tool instead, as `tool` in the recording")


def _canonical(name: str) -> str:
    """A name in small letters; of a number, as ports have in several spellings, its value."""
    text = re.sub(r"^port\s*", "", name.strip().lower())
    try:
        return str(int(text, 16 if text.startswith("0x") else 10))
    except ValueError:
        return text
