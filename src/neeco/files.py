"""Files that appear whole or not at all."""

from __future__ import annotations

import contextlib
import json
import os
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from neeco.errors import NeecoError


def write_atomically(path: Path, write: Callable[[Path], object]) -> None:
    """Let `write(temporary_path)` produce a file beside `path`, sync it to disk and rename it to `path`.

    On any failure the temporary file is removed and `path` is left as it was.
    Raises NeecoError naming `path` when the disk refuses.
    """
    path = Path(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        # keep the suffix: some writers choose the format by it
        handle, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.stem}.", suffix=path.suffix)
    except OSError as error:
        raise NeecoError(f"{path}: cannot write here: {error.strerror or error}") from error
    os.close(handle)
    temporary = Path(name)
    try:
        write(temporary)
        with open(temporary, "rb") as stream:
            os.fsync(stream.fileno())
        os.chmod(temporary, 0o644)
        os.replace(temporary, path)
    except OSError as error:
        raise NeecoError(f"{path}: cannot write: {error.strerror or error}") from error
    finally:
        with contextlib.suppress(FileNotFoundError):
            temporary.unlink()


@contextlib.contextmanager
def new_folder(path: Path) -> Iterator[None]:
    """Make folder `path` and those above it, as far as they are missing, and make sure that files can be written there.

    When the block fails, folders made here that are still empty go again. Raises NeecoError when the disk refuses.
    """
    path = Path(path)
    made = [folder for folder in (path, *path.parents) if not folder.exists()]
    try:
        path.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=path):
            pass
    except OSError as error:
        _remove_empty(made)
        raise NeecoError(f"{path}: cannot write here: {error.strerror or error}; give another folder") from error
    try:
        yield
    except BaseException:
        _remove_empty(made)
        raise


def _remove_empty(folders: list[Path]) -> None:
    with contextlib.suppress(OSError):  # the first that is not empty ends it
        for folder in folders:
            folder.rmdir()


def write_text(path: Path, text: str) -> None:
    """Write `text` to `path` atomically (see `write_atomically`)."""

    def write(temporary: Path) -> None:
        temporary.write_text(text, encoding="utf-8")

    write_atomically(path, write)


def write_json(path: Path, value: Any) -> None:
    """Write `value` as indented JSON, atomically. NaN and infinity are refused (ValueError): JSON has no such
    numbers."""
    write_text(path, json.dumps(value, indent=1, allow_nan=False) + "\n")


def require_file(path: Path, expected: str) -> None:
    """Raise NeecoError when `path` is there but is no file: a folder, or a pipe or device whose reading may not end."""
    if path.exists() and not path.is_file():
        raise NeecoError(f"{path}: is not a file; expected {expected}")


def read_bytes(path: Path, expected: str, missing: str = "no such file") -> bytes:
    """What a file holds.

    Raises NeecoError saying `missing` when it is absent, what was `expected` when it is a folder or a pipe, and why
    when it cannot be read.
    """
    try:
        require_file(path, expected)
        return path.read_bytes()
    except FileNotFoundError:
        raise NeecoError(f"{path}: {missing}") from None
    except (OSError, ValueError) as error:
        raise NeecoError(
            f"{path}: cannot read: {getattr(error, 'strerror', None) or error}; correct the path"
        ) from error


def read_text(path: Path, expected: str, missing: str = "no such file") -> str:
    """A text file in UTF-8, lines ended by newlines alone. Raises NeecoError as `read_bytes`, and for one that is no
    text."""
    try:
        text = read_bytes(path, expected, missing).decode("utf-8-sig")
    except UnicodeDecodeError:
        raise NeecoError(f"{path}: not a text file; expected {expected}") from None
    return text.replace("\r\n", "\n").replace("\r", "\n")


def read_json(path: Path) -> Any:
    """Parse a JSON file. Raises NeecoError naming the file (and the line) when absent, unreadable or malformed."""
    path = Path(path)
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise NeecoError(f"{path}: no such file") from None
    except OSError as error:
        raise NeecoError(f"{path}: cannot read: {error.strerror or error}; correct the path") from error
    except UnicodeDecodeError:
        raise NeecoError(f"{path}: not a text file; expected JSON") from None
    except json.JSONDecodeError as error:
        raise NeecoError(f"{path}: not valid JSON, line {error.lineno}: {error.msg}; mend or write it anew") from None
