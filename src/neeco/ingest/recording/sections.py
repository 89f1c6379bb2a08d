"""Mappings of recording.yaml, key by key: what is absent reads as None, what is wrong is refused by its place."""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import yaml

from neeco.capture.documents import Node, RaisingReport, printable
from neeco.errors import NeecoError
from neeco.files import YamlLoader

LARGEST = 1e12  # number that any key may hold: more is a slip, and overflows what is computed of it


class Section:
    """A mapping in a file: what is absent reads as None, what is wrong raises NeecoError, as keys other than `keys`
    do."""

    def __init__(self, file: Path, place: str, value: Any, keys: Sequence[str]) -> None:
        self.file, self.place = file, place
        self.node = Node(value, str(file), place, RaisingReport())
        if not isinstance(value, dict):
            self.node.error(f"expected keys such as `{keys[0]}:`, found {printable(value)}", "write them as key: value")
        self.value: dict[str, Any] = value
        for key in value:
            if key not in keys:
                likely = close_match(str(key), keys)
                hint = f"did you mean {likely}?" if likely else f"the keys here are {', '.join(keys)}"
                raise self.error(printable(key) if not isinstance(key, str) else key, f"unknown key; {hint}")

    def error(self, key: str, message: str) -> NeecoError:
        return NeecoError(" ".join(f"{self.file}: {self.at(key)}: {message}".split()))

    def at(self, key: str) -> str:
        """Where a key of this section stands in its file."""
        return ".".join(part for part in (self.place, key) if part)

    def section(self, key: str, keys: Sequence[str]) -> Section:
        """The mapping under a key; empty when absent."""
        value = self.value.get(key)
        return Section(self.file, self.at(key), {} if value is None else value, keys)

    def text(self, key: str, required: bool = False) -> Any:
        """A name (YAML makes whole numbers of some), or None."""
        value = self.value.get(key)
        if value is None and required:
            raise self.error(key, "missing; give it")
        if isinstance(value, int) and not isinstance(value, bool):
            return str(value)
        return None if value is None else self.node.child(key).text("put it in quotes if it is a name")

    def path(self, key: str, required: bool = False) -> Any:
        """An existing file or folder, relative to this file, or None."""
        text = self.text(key, required)
        if text is None:
            return None
        try:
            path = self.file.parent / Path(text).expanduser()
            found = path.exists()
        except (OSError, ValueError, RuntimeError):
            found = False
        if not found:
            raise self.error(key, f"no such file: {printable(text, 120)}; correct it (relative to {self.file.name})")
        return path

    def number(
        self, key: str, above: float | None = None, least: float | None = None, below: float = LARGEST
    ) -> float | None:
        return self.node.child(key).number(above, least, below) if self.node.has(key) else None

    def integer(self, key: str, least: int) -> int | None:
        return self.node.child(key).integer(least) if self.node.has(key) else None

    def names(self, key: str, counts: tuple[int, ...]) -> tuple[str, ...] | None:
        """Names of columns, as a list or, for one, alone."""
        value = self.value.get(key)
        if value is None:
            return None
        items = value if isinstance(value, list) else [value]
        good = all(isinstance(item, str | int) and not isinstance(item, bool) for item in items)
        if not good or len(items) not in counts:
            wanted = "the name of a column" if counts == (1,) else f"{' or '.join(map(str, counts))} names of columns"
            raise self.error(key, f"expected {wanted}, found {printable(value)}; list them")
        if len({str(item) for item in items}) < len(items):
            raise self.error(key, "names a column twice; list different columns")
        return tuple(str(item) for item in items)

    def ranges(self, key: str) -> tuple[tuple[int, int], ...]:
        """Frame numbers and ranges such as "30-40", as (first, last)."""
        value = self.value.get(key)
        if value is None:
            return ()
        found = []
        for item in value if isinstance(value, list) else [value]:
            match = re.fullmatch(r"\s*(\d{1,9})(?:\s*-\s*(\d{1,9}))?\s*", str(item))
            if match is None or int(match[2] or match[1]) < int(match[1]):
                raise self.error(key, f"{printable(item)} is no range of frames; write 12 or 30-40")
            found.append((int(match[1]), int(match[2] or match[1])))
        return tuple(found)


def close_match(name: str, names: Iterable[str]) -> str | None:
    """The name that a misspelt one probably means."""
    return next(iter(difflib.get_close_matches(name, list(names), n=1, cutoff=0.6)), None)


class RecordingLoader(YamlLoader):
    """YAML in which a key given twice is an error: the first would be lost without a word."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        seen: set[str] = set()
        for key, _ in node.value:
            if isinstance(key, yaml.ScalarNode) and key.value in seen:
                problem = f"{printable(key.value)} is given twice; keep one of them"
                raise yaml.constructor.ConstructorError(None, None, problem, key.start_mark)
            seen.add(str(key.value))
        return super().construct_mapping(node, deep)
