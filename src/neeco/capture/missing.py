"""What a path that leads nowhere most likely means."""

from __future__ import annotations

import os
import unicodedata
from functools import lru_cache
from pathlib import Path

from neeco.capture.documents import printable
from neeco.capture.images import EXTENSIONS
from neeco.plausible import Fault

CACHED = 16  # folders whose entries are looked through and remembered
NOWHERE = "put it there or correct the path"


def missing_file(folder: Path, text: str) -> Fault:
    """What to say of a path, relative to `folder`, at which there is no file."""
    message, found = f"no such file: {printable(text)}", similar_file(folder, text)
    if found is None:
        return message, NOWHERE
    if _normal(found) == _normal(text):
        form = (
            "in another Unicode form (macOS decomposes accents)" if found.lower() != text.lower() else "in other case"
        )
        return message, f"{printable(found)} is there, {form}: correct the path"
    return message, f"{printable(found)} is there: correct the path"


def similar_file(folder: Path, text: str) -> str | None:
    """A file under `folder` that differs from a path in separators, case, Unicode form, image extension or folder.

    Relative to `folder`; None where there is none.
    """
    parts = [part for part in text.replace("\\", "/").split("/") if part not in ("", ".")]
    if not parts or ".." in parts:
        return None
    place: Path | None = folder
    for part in parts:
        place = None if place is None else _entry(place, part)
    if place is None or not place.is_file():  # the same name in another folder
        try:
            folders = _folders(folder, os.stat(folder).st_mtime_ns)
        except OSError:
            return None
        named = (_entry(other, parts[-1]) for other in folders)
        place = next((entry for entry in named if entry is not None and entry.is_file()), None)
    return None if place is None else place.relative_to(folder).as_posix()


def _entry(folder: Path, name: str) -> Path | None:
    try:
        entries = _entries(folder, os.stat(folder).st_mtime_ns)
    except OSError:
        return None
    found = entries.get(name) or entries.get(_normal(name)) or entries.get(_without_extension(_normal(name)))
    return None if found is None else folder / found


@lru_cache(maxsize=1)
def _folders(folder: Path, changed: int) -> list[Path]:
    """The folder and the first folders in it. `changed`: when, for the cache."""
    return [folder, *sorted(entry for entry in folder.iterdir() if entry.is_dir())][:CACHED]


@lru_cache(maxsize=CACHED)
def _entries(folder: Path, changed: int) -> dict[str, str]:
    """A folder's entries by their names, normalised names, and those without an image's extension. `changed`: when,
    for the cache."""
    names = sorted(os.listdir(folder))
    plain = {_without_extension(_normal(name)): name for name in names if name.endswith(EXTENSIONS)}
    return plain | {_normal(name): name for name in names} | {name: name for name in names}


def _normal(name: str) -> str:
    return unicodedata.normalize("NFC", name).casefold()


def _without_extension(name: str) -> str:
    return os.path.splitext(name)[0] if name.endswith(EXTENSIONS) else name
