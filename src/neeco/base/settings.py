"""Frozen dataclasses from YAML or JSON by their types, every fault stated with its place; and settings written back and
described for help texts.

The type of a field states how its value is read: a scalar, a list (tuple), an object (another dataclass, dict), one of
several words (Literal), or `Annotated[..., parser]` with a function of the value's `Place`. Null counts as absent where
the type has no None. A class attribute `shorthand` names the field that a value other than an object is for.
"""

from __future__ import annotations

import dataclasses
import inspect
import math
import os
import re
import textwrap
import types
import typing
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Annotated, Any, TypeVar

import tyro

from neeco.base.errors import NeecoError, nearest

Device = Annotated[str, tyro.conf.arg(help="cpu, cuda, cuda:N, or auto: a CUDA device where there is one.")]
T = TypeVar("T")
MAX_INTEGER = 2**63  # limit on an integer: torch accepts no larger one
VALUES = {str: "STR", int: "INT", float: "FLOAT", bool: "true|false"}
FIELD = re.compile(  # of a dataclass: the comments above, the name, the comment behind, the text below
    r'((?:^ {4}# [^\n]*\n)*)^ {4}(\w+): [^\n]*?(?: {2}# ([^\n]*))?\n(?: {4}"""(.*?)""")?', re.MULTILINE | re.DOTALL
)
GROUP = "is a group of fields, each with a value of its own; write them as NAME: VALUE"
WORDS = {Path: "a path", bool: "true or false", int: "a whole number", float: "a number", str: "a word"}


class Fault(ValueError):
    """A fault of a value. field: its place below the value that is read ("" for that itself)."""

    def __init__(self, field: str, message: str) -> None:
        super().__init__(message)
        self.field = field


@contextmanager
def faults_in(file: Path | str) -> Iterator[None]:
    """Raise the block's Fault as NeecoError in one line: `file: place: what is wrong; what to do`."""
    try:
        yield
    except Fault as fault:
        raise NeecoError(": ".join(part for part in (str(file), fault.field, str(fault)) if part)) from None


@dataclass(frozen=True)
class Place:
    """A value of a file, and where it is."""

    value: Any
    file: str = ""
    field: str = ""

    def child(self, key: str) -> typing.Self:
        """The value under `key` (None when absent)."""
        value = self.value.get(key) if isinstance(self.value, Mapping) else None
        return self.at(value, join_places(self.field, key_name(key)))

    def item(self, index: int) -> typing.Self:
        """The element `index` of a list (None when this is not one)."""
        value = self.value[index] if isinstance(self.value, Sequence) and not isinstance(self.value, str) else None
        return self.at(value, f"{self.field}[{index}]")

    def at(self, value: Any, field: str) -> typing.Self:
        """Another value of the file."""
        return type(self)(value, self.file, field)


def join_places(*places: str) -> str:
    """Return one place: `instruments[0].poses` of `instruments` and `[0].poses`."""
    return ".".join(place for place in places if place).replace(".[", "[")


def key_name(key: str) -> str:
    """A JSON key as messages write it."""
    return key if key.isidentifier() else f"[{printable(key)}]"


def printable(value: Any, limit: int = 60) -> str:
    """A value from a file, as one short printable piece of text."""
    if isinstance(value, dict | list):
        return f"{'an object' if isinstance(value, dict) else 'a list'} of {len(value)}"
    if isinstance(value, int) and abs(value) >= 10**20:
        return "a huge integer"
    text = repr(value)
    return text if len(text) <= limit else text[: limit - 3] + "..."


def read(hint: Any, place: Place, owner: str = "it") -> Any:
    """Return the value at `place` as a type asks. owner: who has the fields, in messages. Raises Fault."""
    value, origin, arms = place.value, typing.get_origin(hint), typing.get_args(hint)
    if origin is Annotated:
        return arms[1](place) if isinstance(arms[1], types.FunctionType) else read(arms[0], place, owner)
    if _is_optional(hint):
        (arm,) = (arm for arm in arms if arm is not type(None))
        return None if value is None else read(arm, place, owner)
    if origin is typing.Literal and value not in arms:
        raise Fault(place.field, f"{printable(value)} is none of {', '.join(map(str, arms))}")
    if origin is tuple:
        if isinstance(value, str) or not isinstance(value, Sequence):
            raise Fault(place.field, f"{printable(value)} is not a list; write [{value}]")
        kinds = arms[:1] * len(value) if ... in arms else arms
        if len(value) != len(kinds):
            raise Fault(place.field, f"has {len(value)} values; give {len(kinds)}")
        return tuple(read(kind, place.item(index), owner) for index, kind in enumerate(kinds))
    if dataclasses.is_dataclass(hint):
        return _read_fields(hint, place, owner)
    if origin is dict:
        if not isinstance(value, Mapping) or not all(isinstance(name, str) and name for name in value):
            raise Fault(place.field, GROUP)
        return {name: read(arms[1], place.child(name), owner) for name in value}
    if hint is Path and isinstance(value, str | os.PathLike):
        return Path(value)
    return _scalar(place, hint) if hint in WORDS else value


def structure(kind: type[T], values: Mapping[str, Any], where: str = "", owner: str = "it") -> T:
    """Return the dataclass `kind` with `values`; missing fields keep their defaults. `owner` names their owner in
    messages.

    Raises NeecoError naming the field (`where` and its dotted path) that is unknown or does not fit its type.
    """
    with faults_in(""):
        return read(kind, Place(values, field=where), owner)


def name_and_value(option: str, text: str, example: str) -> tuple[str, str]:
    """Split NAME=VALUE. Raises NeecoError naming `option`, with an `example` of what to write."""
    name, equals, value = text.partition("=")
    if not (name and equals and value):
        raise NeecoError(f"{option}: {text!r} is not NAME=VALUE; write such as {example}")
    return name, value


def plain(settings: Any) -> dict[str, Any]:
    """Return `settings` as dicts, lists and scalars; `structure` is the inverse."""
    return _plain(dataclasses.asdict(settings))


def with_fields(settings: Any, values: Mapping[str, Any]) -> Any:
    """Return the dataclass `settings` with fields changed by name; dots reach nested ones (`refine.latency`)."""
    for name, value in values.items():
        first, _, rest = name.partition(".")
        changed = with_fields(getattr(settings, first), {rest: value}) if rest else value
        settings = dataclasses.replace(settings, **{first: changed})
    return settings


def described(kind: type[Any]) -> Iterator[tuple[str, str, str]]:
    """Yield every field of the dataclass `kind`, those of nested ones by dotted names, as (name, default, what it is);
    what a name or nothing can be replaced by stands in brackets."""
    texts, hints = field_texts(kind), typing.get_type_hints(kind)
    for field in dataclasses.fields(kind):
        default = field.default if field.default_factory is dataclasses.MISSING else field.default_factory()
        if dataclasses.is_dataclass(default):
            yield from ((f"{field.name}.{name}", value, text) for name, value, text in described(type(default)))
            continue
        hint = hints[field.name]
        has_choices = default is None or typing.get_origin(hint) is typing.Literal
        choices = f" ({value_words(hint).strip('{}')})" if has_choices else ""
        text = f"{default:.4g}" if isinstance(default, float) else str(default)
        yield field.name, text, texts.get(field.name, "") + choices


def field_texts(kind: type[Any]) -> dict[str, str]:
    """Return what the fields of the dataclass `kind` are, by name: from the text below each, else from the comments
    above and behind it."""
    texts = {}
    for owner in (owner for owner in reversed(kind.__mro__) if dataclasses.is_dataclass(owner)):
        try:
            source = textwrap.dedent(inspect.getsource(owner))
        except (OSError, TypeError):  # made by a program
            continue
        for above, name, behind, below in FIELD.findall(source):
            comments = " ".join(line.strip().removeprefix("# ") for line in [*above.splitlines(), behind])
            if words := " ".join((below or comments).split()):
                texts[name] = words
    return texts


def value_words(hint: Any) -> str:
    """Return what a value of a type looks like on the command line, such as INT or {on,off}; None does not count."""
    if typing.get_origin(hint) is Annotated:
        return value_words(typing.get_args(hint)[0])
    arms = [arm for arm in typing.get_args(hint) if arm not in (type(None), ...)]
    if typing.get_origin(hint) is typing.Literal:
        return f"{{{','.join(map(str, arms))}}}"
    if typing.get_origin(hint) is tuple:
        repeated = f"[{value_words(arms[0])} ...]"
        return repeated if ... in typing.get_args(hint) else " ".join(map(value_words, arms))
    return "|".join(map(value_words, arms)) if arms else VALUES.get(hint, hint.__name__.upper())


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    return [_plain(item) for item in value] if isinstance(value, list | tuple) else value


def _read_fields(kind: Any, place: Place, owner: str) -> Any:
    value, hints = place.value, _hints(kind)
    if not isinstance(value, Mapping):
        if not (shorthand := getattr(kind, "shorthand", "")):
            raise Fault(place.field, GROUP)
        value = {shorthand: value}
        place = dataclasses.replace(place, value=value)
    for key in value:
        if key not in hints:
            likely, names = nearest(str(key), hints), ", ".join(hints) or "none"
            message = f"{owner} has no such field; it has {names}" + (f"; did you mean {likely}?" if likely else "")
            raise Fault(join_places(place.field, key_name(str(key))), message)
    arguments = {}
    for field in dataclasses.fields(kind):
        if value.get(field.name) is not None or (field.name in value and _is_optional(hints[field.name])):
            arguments[field.name] = read(hints[field.name], place.child(field.name), owner)
        elif field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING:
            raise Fault(join_places(place.field, field.name), "missing; give it")
    try:
        return kind(**arguments)
    except Fault as fault:
        raise Fault(join_places(place.field, fault.field), str(fault)) from None


@cache
def _hints(kind: Any) -> dict[str, Any]:
    hints = typing.get_type_hints(kind, include_extras=True)
    return {field.name: hints[field.name] for field in dataclasses.fields(kind)}


def _is_optional(hint: Any) -> bool:
    return typing.get_origin(hint) in (typing.Union, types.UnionType) and type(None) in typing.get_args(hint)


def _scalar(place: Place, kind: type[Any]) -> Any:
    value = place.value
    allowed = (int, float) if kind is float else (kind,)  # a whole number is a number too
    if not isinstance(value, allowed) or (isinstance(value, bool) and kind is not bool):
        raise Fault(place.field, f"{printable(value)} is not {WORDS[kind]}; give one")
    if isinstance(value, int) and abs(value) >= MAX_INTEGER:
        raise Fault(place.field, "a huge integer is out of range; correct it")
    if isinstance(value, float) and not math.isfinite(value):
        raise Fault(place.field, f"{value!r} is not a finite number; correct it")
    return value
