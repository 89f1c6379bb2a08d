"""Output shared by several verbs: tables that fit the terminal, paths of files, failures, parts of `--help`."""

from __future__ import annotations

import dataclasses
import itertools
import json
import os
import re
import typing
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from functools import cache
from pathlib import Path
from typing import Annotated, Any

import tyro
from rich.console import Console
from rich.table import Table
from rich.text import Text

from neeco.base.errors import NeecoError, nearest
from neeco.base.files import finite, new_folder, require_replaceable, write_json
from neeco.base.settings import field_texts, value_words
from neeco.studies.configurations import ResultTable

STANDARD_OUTPUT = Path("-")  # value of --json
FILE_WIDTH = 1000  # maximum width of lines in files and pipes
BORDER = 3  # additional characters per column


JsonTarget = Annotated[
    Path | None,
    tyro.conf.arg(
        metavar="[FILE]",
        help="Write the numbers as one JSON object into FILE; without FILE to standard output, and nothing else there.",
        help_behavior_hint="(optional)",
    ),
]


def whole_lines(*, stderr: bool = False) -> Console:
    """Return a console that neither cuts nor wraps lines in files and pipes, which have no terminal width."""
    console = Console(stderr=stderr)
    if not console.is_terminal and "COLUMNS" not in os.environ:
        console.width = FILE_WIDTH
    return console


def fitted(table: ResultTable, width: int) -> list[Table]:
    """Split a table into pieces that fit a terminal of `width` characters; each has the key columns, and the first cell
    of a failed row. The best of a column and reference rows are bold."""
    headings, keys = [*table.keys, *(column.title for column in table.columns)], len(table.keys)
    rows = []
    for row in table.rows:
        cells = [Text(str(cell), "bold" if cell.best or row.reference else "") for cell in row.cells]
        failed = [Text("failed", "red")] * len(table.columns)
        rows.append(
            [*(Text(key, "bold" if row.reference else "") for key in row.keys), *(failed if row.failed else cells)]
        )
    widths = [
        max([*map(len, heading.split()), *(len(row[at]) for row in rows)], default=0)
        for at, heading in enumerate(headings)
    ]
    pieces: list[list[int]] = []
    for at in range(keys, len(headings)):
        columns = [*range(keys), *(pieces[-1] if pieces else ()), at]
        if not pieces or sum(BORDER + widths[index] for index in columns) >= width:
            pieces.append([])
        pieces[-1].append(at)
    tables: list[Table] = []
    for piece in pieces or [[]]:
        title = f"{table.title}, continued" if tables else table.title
        part = Table(title=Text(title, "italic", no_wrap=True, overflow="ignore"), title_justify="left")
        for at in (*range(keys), *piece):
            numbers: dict[str, Any] = {"justify": "right", "width": widths[at]} if at >= keys else {"no_wrap": True}
            part.add_column(headings[at], **numbers)
        for row, cells in zip(table.rows, rows, strict=True):
            part.add_row(*cells[:keys], *(cells[at] for at in (piece[:1] if row.failed else piece)))
        tables.append(part)
    return tables


def print_outcome(
    files: Mapping[str, Path | str],
    tables: Sequence[ResultTable],
    *,
    sentences: Sequence[str] = (),
    notes: Sequence[str],
    failed: Sequence[str],
    runs: str,
) -> int:
    """Print tables, sentences, notes and file paths by title; return 1 if any of `runs` (`3 runs`) failed, after
    printing the first failure."""
    console = whole_lines()
    for table in tables:
        for piece in fitted(table, console.width):
            console.print(piece)
    for sentence in sentences:
        console.print(sentence, markup=False, highlight=False)
    for note in notes:
        console.print(f"note: {note}", style="dim", markup=False, highlight=False)
    for title, place in files.items():
        console.print(f"{title}: {place}", markup=False, highlight=False, soft_wrap=True)
    if not failed:
        return 0
    others = f" (and {len(failed) - 1} more, listed above)" if len(failed) > 1 else ""
    text = f"neeco: error: {len(failed)} of {runs} failed: {failed[0]}{others}"
    Console(stderr=True).print(text, markup=False, highlight=False, soft_wrap=True)
    return 1


def require_ending(option: str, path: Path, *endings: str) -> None:
    """Raise NeecoError if the extension of an output file belongs to another format than the one written, whose
    extensions are `endings`; files without an extension are accepted."""
    if path.suffix and path.suffix.lower() not in endings:
        raise NeecoError(f"{option}: {path}: wrong file name extension; use {' or '.join(endings)}")


def write_numbers(path: Path | None, numbers: Any) -> bool:
    """Write the numbers requested by `--json`; return True if they are the whole standard output."""
    if path == STANDARD_OUTPUT:
        print(json.dumps(finite(numbers), indent=2, allow_nan=False))
    elif path is not None:
        write_json(path, numbers)
    return path == STANDARD_OUTPUT


@contextmanager
def ready_for_json(path: Path | None) -> Iterator[None]:
    """Check, before a long computation, that the file of `--json` can be written.

    Raises NeecoError for a folder, a name of another format, or a file whose folder cannot be written to.
    """
    file = None if path == STANDARD_OUTPUT else path
    if file is not None:
        if file.is_dir():
            raise NeecoError(f"--json: {file}: is a folder; give a file, or no value to print to standard output")
        require_ending("--json", file, ".json")
        require_replaceable(file)
    with nullcontext() if file is None else new_folder(file.parent):
        yield


DEFAULT = " Default: "  # prefix of the last sentence of an option's text, for defaults without a value


def _options(kind: Any) -> Iterator[tuple[Any, dataclasses.Field[Any], Any, tuple[Any, ...]]]:
    """Yield the options of a dataclass of arguments: owner, field, type and markers; nested ones add theirs."""
    hints = typing.get_type_hints(kind, include_extras=True)
    for field in dataclasses.fields(kind):
        hint = hints[field.name]
        bare = typing.get_args(hint)[0] if typing.get_origin(hint) is Annotated else hint
        if dataclasses.is_dataclass(bare):
            yield from _options(bare)
        else:
            yield kind, field, bare, getattr(hint, "__metadata__", ())


@cache
def state_defaults(kind: Any) -> None:
    """Make the help of a dataclass of arguments state the behaviour of omitted options without a default value: the
    text behind DEFAULT, in place of None."""
    for owner, field, bare, markers in list(_options(kind)):
        added = []
        repeated, texts = typing.get_origin(bare) is tuple, field_texts(owner)
        if tyro.conf.Positional in markers and not any(getattr(marker, "metavar", None) for marker in markers):
            name = f"[{field.name} ...]" if repeated else field.name
            added.append(tyro.conf.arg(metavar=name.upper()))
        required = field.default is dataclasses.MISSING and repeated
        empty = required or field.default in (None, ())
        if empty and field.name in texts and tyro.conf.UseAppendAction not in markers:
            text, _, default = texts[field.name].removesuffix(".").partition(DEFAULT)
            end = f"(default: {default})" if default else "(required)" if required else "(optional)"
            added += [] if tyro.conf.Positional in markers else [tyro.conf.arg(metavar=value_words(bare))]
            added.append(tyro.conf.arg(help=text, help_behavior_hint=end))
        for marker in (*markers, *added) if added else ():
            bare = Annotated[bare, marker]
            owner.__annotations__[field.name] = bare


def usage_error(box: str, words: Sequence[str], kind: Any) -> str:
    """Return a one-line message for a command line that tyro refused in a framed `box`: similar options for unknown
    ones, else tyro's words without its frame and its list of similar options."""
    options, slips = list[str](), []
    for _, field, _, markers in _options(kind):
        if tyro.conf.Positional not in markers:
            name = next(filter(None, (getattr(marker, "name", None) for marker in markers)), field.name)
            options.append(f"--{'no-' if field.default is True else ''}{name.replace('_', '-')}")
    options.append("--help")
    for option in (word.partition("=")[0] for word in words):
        if option.startswith("--") and option not in options and (meant := nearest(option, options)) is not None:
            slips.append(f"{option}: no such option of {words[0]}; did you mean {meant}?")
    if slips:
        return " ".join(slips)
    rows = [row[2:].rstrip("│ ") for row in re.sub("\x1b\\[[0-9;]*m", "", box).splitlines()[1:-1]]
    rows = rows[bool(rows) and not rows[0].strip("-") :]  # title line of an ASCII frame
    first = list(itertools.takewhile(lambda row: row.strip("─-"), rows))  # up to the next line of the frame
    line = " ".join(f"{row}:" if re.match(" {4}[^ ]", row) else row for row in first)  # names of what is missing
    line = re.sub(r"[. ]*\(required\)", ";", " ".join(line.split())).rstrip(".;").removeprefix("Error parsing ")
    line = re.sub("^Missing from [^:]+:", f"{words[0]}: missing", line)
    line = re.sub(
        r"no type matching \{None\}\|\{?([^{}]*)\}? could be instantiated from \[(.*)\]", r"expected \1, got \2", line
    )
    line = line.replace("invalid literal for int() with base 10:", "expected INT, got")
    line = line.replace("could not convert string to float:", "expected FLOAT, got")
    line = line.replace("Unrecognized options:", f"{words[0]}: no such option or argument:")
    if value := re.search(r"Missing value for argument '--([\w-]+)'|^--([\w-]+): expected", line):
        option = value[1] or value[2]
        text = field_texts(kind).get(option.replace("-", "_"), "").partition(DEFAULT)[0].rstrip(".")
        line = f"{line if value[2] else f'--{option}: needs a value'}: {text}".rstrip(" :")
    return f"{line}; see `neeco {words[0]} --help`"
