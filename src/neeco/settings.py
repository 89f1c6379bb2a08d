"""Settings as frozen dataclasses: read from YAML or JSON by their types, written back, described for help texts.

cattrs structures nested dataclasses, tuples and optional fields. Scalars have their own hooks: cattrs would accept "3"
as a number and any text as true.
"""

from __future__ import annotations

import dataclasses
import inspect
import math
import re
import textwrap
import types
import typing
from collections.abc import Iterator, Mapping, Sequence
from functools import cache
from typing import Annotated, Any, TypeVar

import tyro

from neeco.errors import NeecoError, nearest

Device = Annotated[str, tyro.conf.arg(help="cpu, cuda, cuda:N, or auto: a CUDA device where there is one.")]
T = TypeVar("T")
MAX_INTEGER = 2**63  # torch accepts no larger one
VALUES = {str: "STR", int: "INT", float: "FLOAT", bool: "true|false"}
FIELD = re.compile(  # of a dataclass: the comments above, the name, the comment behind, the text below
    r'((?:^ {4}# [^\n]*\n)*)^ {4}(\w+): [^\n]*?(?: {2}# ([^\n]*))?\n(?: {4}"""(.*?)""")?', re.MULTILINE | re.DOTALL
)
WORDS = {bool: "true or false", int: "a whole number", float: "a number", str: "a word"}


def structure(kind: type[T], values: Mapping[str, Any], where: str = "", owner: str = "it") -> T:
    """Return the dataclass `kind` with `values`; missing fields keep their defaults. `owner` names their owner in
    messages.

    Raises NeecoError naming the field (`where` and its dotted path) that is unknown or does not fit its type.
    """
    from cattrs.errors import BaseValidationError

    try:
        return _converter().structure(values, kind)
    except BaseValidationError as error:
        raise NeecoError(next(_problems(error, where, owner))) from None


def name_and_value(option: str, text: str, example: str) -> tuple[str, str]:
    """Split NAME=VALUE. Raises NeecoError naming `option`, with an `example` of what to write."""
    name, equals, value = text.partition("=")
    if not (name and equals and value):
        raise NeecoError(f"{option}: {text!r} is not NAME=VALUE; write such as {example}")
    return name, value


def plain(settings: Any) -> dict[str, Any]:
    """Return `settings` as dicts, lists and scalars; `structure` is the inverse."""
    value = _plain(dataclasses.asdict(settings))
    assert isinstance(value, dict)
    return value


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
        shown = default is None or typing.get_origin(hint) is typing.Literal
        choices = f" ({value_words(hint).strip('{}')})" if shown else ""
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


@cache
def _converter() -> Any:
    import cattrs

    converter = cattrs.Converter(forbid_extra_keys=True)
    for kind in WORDS:
        converter.register_structure_hook(kind, _scalar)
    converter.register_structure_hook_func(lambda kind: typing.get_origin(kind) is typing.Literal, _word)
    converter.register_structure_hook_func(_is_optional, lambda value, kind: _optional(converter, value, kind))
    converter.register_structure_hook_func(
        lambda kind: typing.get_origin(kind) is tuple, lambda value, kind: _tuple(converter, value, kind)
    )
    return converter


def _scalar(value: Any, kind: type[Any]) -> Any:
    allowed = (int, float) if kind is float else (kind,)  # a whole number is a number too
    if not isinstance(value, allowed) or (isinstance(value, bool) and kind is not bool):
        raise ValueError(f"{value!r} is not {WORDS[kind]}")
    if isinstance(value, int) and abs(value) >= MAX_INTEGER:
        raise ValueError("a huge integer is out of range")
    if isinstance(value, float) and not math.isfinite(value):
        raise ValueError(f"{value!r} is not a finite number")
    return value


def _word(value: Any, kind: Any) -> Any:
    allowed = typing.get_args(kind)
    if value not in allowed:
        raise ValueError(f"{value!r} is none of {', '.join(map(str, allowed))}")
    return value


def _is_optional(kind: Any) -> bool:
    return typing.get_origin(kind) in (typing.Union, types.UnionType) and type(None) in typing.get_args(kind)


def _optional(converter: Any, value: Any, kind: Any) -> Any:
    (arm,) = (arm for arm in typing.get_args(kind) if arm is not type(None))
    return None if value is None else converter.structure(value, arm)


def _tuple(converter: Any, value: Any, kind: Any) -> Any:
    item, *_ = typing.get_args(kind)
    if isinstance(value, str) or not isinstance(value, Sequence):
        raise ValueError(f"{value!r} is not a list; write [{value}]")
    return tuple(converter.structure(entry, item) for entry in value)


def _problems(error: BaseException, where: str, owner: str) -> Iterator[str]:
    """Yield the messages of a structuring error, field by field."""
    from cattrs.errors import (
        AttributeValidationNote,
        BaseValidationError,
        ForbiddenExtraKeysError,
        IterableValidationNote,
    )

    if isinstance(error, BaseValidationError):
        for inner in error.exceptions:
            notes = getattr(inner, "__notes__", [])
            names = [note.name for note in notes if isinstance(note, AttributeValidationNote)]
            names += [str(note.index) for note in notes if isinstance(note, IterableValidationNote)]
            yield from _problems(inner, _dotted(where, *names), owner)
    elif isinstance(error, ForbiddenExtraKeysError):
        known = [field.name for field in dataclasses.fields(error.cl)]
        for name in sorted(error.extra_fields):
            meant = nearest(name, known)
            hint = "" if meant is None else f"; did you mean {meant}?"
            yield f"{_dotted(where, name)}: {owner} has no such field; it has {', '.join(known) or 'none'}{hint}"
    elif isinstance(error, NeecoError):
        yield str(error)
    elif isinstance(error, ValueError):
        yield f"{where}: {error}"
    else:
        yield f"{where}: is a group of fields, each with a value of its own"


def _dotted(*names: str) -> str:
    return ".".join(name for name in names if name)
