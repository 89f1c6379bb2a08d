"""NeecoError, the only exception for users, and the message for insufficient memory in any library."""

from __future__ import annotations

import errno
import os
import re
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress

# what libraries without a MemoryError of their own say: PyTorch, safetensors, OpenCV, the dynamic linker, threads
MEMORY_MESSAGES = re.compile(
    "can(?:no|')t allocate memory|not enough memory|insufficient memory|out of memory error|bad_alloc|"
    "failed to map segment|can't start new thread",
    re.IGNORECASE,
)
OPTION = re.compile(r"(?<![\w/-])--(?:set:? ([A-Za-z_][\w.]*)|(no-)?([a-z][a-z-]*[a-z]|[a-z]))(?![\w/-])")
TOO_LITTLE = "memory: too little"  # begins every line of `memory_failure`


class NeecoError(Exception):
    """Bad input. The message is one line naming the file or argument, the field and what to do; the command line prints
    it, with options in place of arguments (`command_line`), and exits 1.

        try:
            neeco.load("runs/nothing")
        except neeco.NeecoError as error:
            print(error)
    """

    command_line: str | None = None  # the message as the command line words it, where that differs

    def __init__(self, message: str = "") -> None:
        super().__init__(visible(message))


def visible(text: str) -> str:
    """Return text in one line without control characters (from files), which could move a terminal's cursor."""
    line = re.sub(r"\s*[^\S ]\s*", " ", text)  # line breaks and tabs, with the spaces around
    return line if line.isprintable() else "".join(sign if sign.isprintable() else repr(sign)[1:-1] for sign in line)


def install_hint(extra: str) -> str:
    """Return the command that installs an extra of neeco ("view"). No package index has neeco yet."""
    return f"pip install '.[{extra}]' in neeco's checkout"


@contextmanager
def naming_arguments() -> Iterator[None]:
    """Name arguments of Python in the messages of errors raised in the block, or in the function so decorated:
    `max_attempts` for `--max-attempts`, `density__min_opacity` for `--set density.min_opacity`. Commands quoted in
    backticks stay."""

    def argument(option: re.Match[str]) -> str:
        setting, off, name = option.groups()
        word: str = setting.replace(".", "__") if setting else name.replace("-", "_")
        return f"{word}=False" if off else word

    try:
        yield
    except NeecoError as error:
        words = str(error).split("`")
        words[::2] = [OPTION.sub(argument, text) for text in words[::2]]
        error.command_line = error.command_line or str(error)
        error.args = ("`".join(words),)
        raise


def counted(count: int, noun: str) -> str:
    """Return `1 frame`, `2 frames`."""
    return f"{count} {noun}{'' if count == 1 else 's'}"


def nearest(name: str, names: Iterable[str]) -> str | None:
    """Return the name in `names` that is most similar to `name`; None where none is similar."""
    from difflib import get_close_matches  # slow to import

    return next(iter(get_close_matches(name, list(names), n=1)), None)


def memory_failure(error: BaseException) -> str | None:
    """Return a one-line message on insufficient memory, with its size and a remedy; None if neither `error` nor any of
    its causes is of that kind."""
    if isinstance(error, NeecoError) and str(error).startswith(TOO_LITTLE):
        return str(error)
    cause: BaseException | None = error
    while cause is not None:
        if isinstance(cause, MemoryError) or (isinstance(cause, OSError) and cause.errno == errno.ENOMEM):
            break
        if not isinstance(cause, NeecoError) and MEMORY_MESSAGES.search(str(cause)):
            break
        cause = cause.__cause__ or cause.__context__
    if cause is None:
        return None
    asked = re.search(r"allocate (\d+(?:\.\d+)?)\.? (\w+)", str(cause))
    numbers = [f"{_size(asked[1], asked[2])} more were asked for"] if asked else []
    with suppress(ImportError):  # Windows
        import resource

        # the limit set for this process, else the machine's memory
        limits = [resource.getrlimit(kind)[0] for kind in (resource.RLIMIT_AS, resource.RLIMIT_DATA)]
        memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
        least = min([memory, *(limit for limit in limits if limit != resource.RLIM_INFINITY)])
        numbers.append(f"this process may use {_size(str(least), 'bytes')}")
    details = f" ({', '.join(numbers)})" if numbers else ""
    return (
        f"{TOO_LITTLE}{details}: close other programs or raise the limit (ulimit -v), take smaller images "
        "(--scale 0.5), fewer Gaussians (--max-tissue-gaussians), fewer --workers, or a machine with more"
    )


def _size(number: str, unit: str) -> str:
    """Format a size in memory in the largest suitable binary unit."""
    if unit != "bytes":
        return f"{number} {unit}"
    value, units = float(number), ["bytes", "KiB", "MiB", "GiB", "TiB"]
    while value >= 1024 and len(units) > 1:
        value /= 1024
        del units[0]
    return f"{value:.3g} {units[0]}"
