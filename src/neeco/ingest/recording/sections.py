"""Parsers of values of recording.yaml, for the types of fields of frozen dataclasses (`neeco.base.settings.read`)."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

from neeco.base.settings import Fault, printable
from neeco.capture.documents import Node

Parser = Callable[[Node], Any]
MAX_NUMBER = 1e12  # of any key: more is a slip, and overflows what is computed from it


def text(node: Node) -> str:
    """Return a name, which YAML may have read as a whole number."""
    if isinstance(node.value, int) and not isinstance(node.value, bool):
        return str(node.value)
    return node.text("put it in quotes if it is a name")


def existing_file(node: Node) -> Path:
    """Return the path of an existing file or folder, relative to the file that names it."""
    name, file = text(node), Path(node.file)
    try:
        path = file.parent / Path(name).expanduser()
        exists = path.exists()
    except (OSError, ValueError, RuntimeError):
        exists = False
    if not exists:
        raise Fault(node.field, f"no such file: {printable(name, 120)}; correct it (relative to {file.name})")
    return path


def number(above: float | None = None, least: float | None = None, below: float = MAX_NUMBER) -> Parser:
    """Return the parser of a number within bounds."""
    return lambda node: node.number(above, least, below)


def integer(least: int) -> Parser:
    """Return the parser of a whole number."""
    return lambda node: node.integer(least)


def word(*names: str) -> Parser:
    """Return the parser of one of some names, in small letters."""

    def parse(node: Node) -> str:
        if text(node).lower() not in names:
            raise Fault(node.field, f"{printable(node.value)} is not known here; write one of {', '.join(names)}")
        return text(node).lower()

    return parse


def columns(*counts: int) -> Parser:
    """Return the parser of so many names of columns: a list or, for one, a name."""

    def parse(node: Node) -> tuple[str, ...]:
        items = node.value if isinstance(node.value, list) else [node.value]
        good = all(isinstance(item, str | int) and not isinstance(item, bool) for item in items)
        if not good or len(items) not in counts:
            wanted = "the name of a column" if counts == (1,) else f"{' or '.join(map(str, counts))} names of columns"
            raise Fault(node.field, f"expected {wanted}, found {printable(node.value)}; list them")
        if len({str(item) for item in items}) < len(items):
            raise Fault(node.field, "names a column twice; list different columns")
        return tuple(str(item) for item in items)

    return parse


def ranges(node: Node) -> tuple[tuple[int, int], ...]:
    """Return frame numbers and ranges such as "30-40", as (first, last)."""
    spans = []
    for item in node.value if isinstance(node.value, list) else [node.value]:
        match = re.fullmatch(r"\s*(\d{1,9})(?:\s*-\s*(\d{1,9}))?\s*", str(item))
        if match is None or int(match[2] or match[1]) < int(match[1]):
            raise Fault(node.field, f"{printable(item)} is no range of frames; write 12 or 30-40")
        spans.append((int(match[1]), int(match[2] or match[1])))
    return tuple(spans)


Name = Annotated[str, text]
File = Annotated[Path, existing_file]
Positive = Annotated[float, number(above=0.0)]
Count = Annotated[int, integer(1)]
