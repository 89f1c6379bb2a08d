"""Mappings of recording.yaml as frozen dataclasses: cattrs structures the fields, parsers read the values, and every
fault is stated with its place.

The type of a field states how its value is read: text, a number above 0, a whole number from 1, true or false, the Path
of an existing file, another such dataclass, or `Annotated[..., parser]` with a function of the value's Node. Keys with
null count as absent. A class attribute `shorthand` names the field that a value other than a mapping is for.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import fields, is_dataclass
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any, NoReturn, TypeVar, get_args, get_origin, get_type_hints

import cattrs
from cattrs.errors import AttributeValidationNote, BaseValidationError
from cattrs.gen import make_dict_structure_fn, override

from neeco.capture.documents import Node, ProblemReport, printable
from neeco.errors import NeecoError, nearest

T = TypeVar("T")
Parser = Callable[[Node], Any]
MAX_NUMBER = 1e12  # of any key: more is a slip, and overflows what is computed from it


class Fault(ValueError):
    """A fault of a value. field: its place below the value that is read ("" for that itself)."""

    def __init__(self, field: str, message: str) -> None:
        super().__init__(message)
        self.field = field


class _FaultReport(ProblemReport):
    def error(self, file: str, field: str, message: str, remedy: str = "") -> NoReturn:
        raise Fault(field, f"{message}; {remedy}" if remedy else message)


@contextmanager
def faults_in(file: Path) -> Iterator[None]:
    """Raise the block's Fault as NeecoError in one line: `file: place: what is wrong; what to do`."""
    try:
        yield
    except Fault as fault:
        raise NeecoError(f"{join_places(str(file), fault.field, join=': ')}: {fault}") from None


def node_of(value: Any, file: Path, field: str = "") -> Node:
    """Return a value of a file whose reading raises Fault."""
    return Node(value, str(file), field, _FaultReport())


def read_section(kind: type[T], node: Node) -> T:
    """Return the dataclass `kind` with the values of a mapping. Raises Fault."""
    try:
        return _converter(node.file).structure(node.value, kind)
    except (BaseValidationError, Fault) as error:
        raise _first_fault(error, node.field) from None


def list_of(kind: type[Any]) -> Parser:
    """Return the parser of a list of mappings."""

    def parse(node: Node) -> tuple[Any, ...]:
        if not isinstance(node.value, list):
            raise Fault(node.field, f"must be a list; begin each entry with `- {fields(kind)[0].name}:`")
        return tuple(read_section(kind, item) for item in node.items())

    return parse


def mapping_of(kind: type[Any], example: str) -> Parser:
    """Return the parser of mappings by name. example: of one, for messages."""

    def parse(node: Node) -> dict[str, Any]:
        if not isinstance(node.value, dict) or not all(isinstance(name, str) and name for name in node.value):
            raise Fault(node.field, f"must give a name to each, as in `{example}`")
        found = {}
        for name, value in node.value.items():
            place = join_places(node.field, name)
            found[name] = read_section(kind, Node(value, node.file, place, node.report))
        return found

    return parse


def text(node: Node) -> str:
    """Return a name, which YAML may have read as a whole number."""
    if isinstance(node.value, int) and not isinstance(node.value, bool):
        return str(node.value)
    return node.text("put it in quotes if it is a name") or ""


def existing_file(node: Node) -> Path:
    """Return the path of an existing file or folder, relative to the file that names it."""
    name, file = text(node), Path(node.file)
    try:
        path = file.parent / Path(name).expanduser()
        found = path.exists()
    except (OSError, ValueError, RuntimeError):
        found = False
    if not found:
        raise Fault(node.field, f"no such file: {printable(name, 120)}; correct it (relative to {file.name})")
    return path


def number(above: float | None = None, least: float | None = None, below: float = MAX_NUMBER) -> Parser:
    """Return the parser of a number within bounds."""
    return lambda node: node.number(above, least, below)


def integer(least: int) -> Parser:
    """Return the parser of a whole number."""
    return lambda node: node.integer(least)


def flag(node: Node) -> bool:
    """Return true or false."""
    if not isinstance(node.value, bool):
        raise Fault(node.field, f"expected true or false, found {printable(node.value)}")
    return node.value


def word(names: Sequence[str], fault: str, remedy: str) -> Parser:
    """Return the parser of one of some names, in small letters."""

    def parse(node: Node) -> str:
        if text(node).lower() not in names:
            raise Fault(node.field, f"{printable(node.value)} {fault}; {remedy}")
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
    found = []
    for item in node.value if isinstance(node.value, list) else [node.value]:
        match = re.fullmatch(r"\s*(\d{1,9})(?:\s*-\s*(\d{1,9}))?\s*", str(item))
        if match is None or int(match[2] or match[1]) < int(match[1]):
            raise Fault(node.field, f"{printable(item)} is no range of frames; write 12 or 30-40")
        found.append((int(match[1]), int(match[2] or match[1])))
    return tuple(found)


def join_places(*places: str, join: str = ".") -> str:
    """Return one place: `instruments[0].poses` of `instruments` and `[0].poses`."""
    return join.join(place for place in places if place).replace(".[", "[")


_PARSERS: dict[type[Any], Parser] = {
    str: text, float: number(above=0.0), int: integer(1), bool: flag, Path: existing_file,
}  # fmt: skip


@lru_cache(maxsize=4)
def _converter(file: str) -> cattrs.Converter:
    """Return the converter of values in a file."""
    converter = cattrs.Converter()
    for kind, parser in _PARSERS.items():
        converter.register_structure_hook(kind, _hook(parser, file))
    converter.register_structure_hook_factory(is_dataclass, lambda kind: _section_hook(converter, kind, file))
    return converter


def _hook(parser: Parser, file: str) -> Callable[[Any, Any], Any]:
    return lambda value, _: parser(Node(value, file, "", _FaultReport()))


def _section_hook(converter: cattrs.Converter, kind: type[Any], file: str) -> Callable[[Any, Any], Any]:
    hints = get_type_hints(kind, include_extras=True)
    arms = {name: (hint, *get_args(hint)) for name, hint in hints.items()}  # X | None holds X
    own = {name: arm.__metadata__[0] for name in hints for arm in arms[name] if get_origin(arm) is Annotated}
    overrides: dict[str, Any] = {name: override(struct_hook=_hook(parser, file)) for name, parser in own.items()}
    build: Any = make_dict_structure_fn(kind, converter, **overrides)
    names, shorthand = [field.name for field in fields(kind)], getattr(kind, "shorthand", None)

    def structure(value: Any, _: Any) -> Any:
        if not isinstance(value, dict):
            if shorthand is None:
                problem = f"expected keys such as `{names[0]}:`, found {printable(value)}; write them as key: value"
                raise Fault("", problem)
            value = {shorthand: value}
        for key in value:
            if key not in names:
                likely = nearest(str(key), names)
                hint = f"did you mean {likely}?" if likely else f"the keys here are {', '.join(names)}"
                raise Fault(key if isinstance(key, str) else printable(key), f"unknown key; {hint}")
        return build({key: item for key, item in value.items() if item is not None}, kind)

    return structure


def _first_fault(error: BaseException, place: str) -> Fault:
    """Return the first fault that cattrs met, at its place below `place`. Raises the NeecoError of another file."""
    if isinstance(error, BaseValidationError):
        inner = error.exceptions[0]
        notes = [note.name for note in getattr(inner, "__notes__", ()) if isinstance(note, AttributeValidationNote)]
        return _first_fault(inner, join_places(place, *notes))
    if isinstance(error, Fault):
        return Fault(join_places(place, error.field), str(error))
    if isinstance(error, KeyError):
        return Fault(place, "missing; give it")
    raise error
