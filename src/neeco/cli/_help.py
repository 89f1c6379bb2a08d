"""Parts of `--help` besides tyro's: how optional values are written, what holds without them, tables of settings."""

from __future__ import annotations

import dataclasses
import typing
from functools import cache
from typing import Annotated, Any

import tyro
from rich import box
from rich.console import Console
from rich.table import Column, Table
from rich.text import Text

from neeco.settings import described, field_texts, value_words

DEFAULT = " Default: "  # begins the last sentence of an option's text, where its default is no value


@cache
def state_defaults(kind: Any) -> None:
    """Make the help of a dataclass of arguments state what holds where an option without a value of its own is left
    out: the text behind DEFAULT, in place of None."""
    texts = field_texts(kind)
    for field in dataclasses.fields(kind):
        hint = typing.get_type_hints(kind, include_extras=True)[field.name]
        bare = typing.get_args(hint)[0] if typing.get_origin(hint) is Annotated else hint
        markers = getattr(hint, "__metadata__", ())
        if dataclasses.is_dataclass(bare):
            state_defaults(bare)  # type: ignore[arg-type]
            continue
        required = field.default is dataclasses.MISSING and typing.get_origin(bare) is tuple
        empty = required or field.default in (None, ())
        if empty and field.name in texts and tyro.conf.UseAppendAction not in markers:
            text, _, default = texts[field.name].removesuffix(".").partition(DEFAULT)
            end = f"(default: {default})" if default else "(required)" if required else "(optional)"
            shown = [] if tyro.conf.Positional in markers else [tyro.conf.arg(metavar=value_words(hint))]
            changed = hint
            for argument in (*shown, tyro.conf.arg(help=text, help_behavior_hint=end)):
                changed = Annotated[changed, argument]
            kind.__annotations__[field.name] = changed


def option_names(kind: Any) -> list[str]:
    """Return the options of a dataclass of arguments, such as `--output`; nested ones add theirs."""
    names = []
    for name, hint in typing.get_type_hints(kind, include_extras=True).items():
        bare = typing.get_args(hint)[0] if typing.get_origin(hint) is Annotated else hint
        names += option_names(bare) if dataclasses.is_dataclass(bare) else [f"--{name.replace('_', '-')}"]
    return names


def print_settings(title: str, kind: type[Any], note: str) -> None:
    """Print a table of the fields of the dataclass `kind`, if it has any, and a line below it."""
    console = Console(highlight=False, markup=False)
    table = Table(Column(no_wrap=True), Column("default"), Column(), title=title, title_justify="left", box=box.ROUNDED)
    for row in described(kind):
        table.add_row(*map(Text, row))
    console.print(table if table.rows else f"{title}: none")
    console.print(note)
