"""A temporary folder that becomes an output once it is whole."""

from __future__ import annotations

import hashlib
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from neeco.base.errors import NeecoError
from neeco.base.files import LOCK, TEMPORARY, cannot_write, new_folder, own_folder


@contextmanager
def staged(output: Path) -> Iterator[Path]:
    """Yield a temporary folder on the disk of `output`, whose `capture` becomes `output` after the block.

    It is removed whatever happens (after SIGKILL: when the same `output` is asked for again).

    Raises NeecoError when something other than an empty folder is at `output`, when another process is making it, and
    when the disk refuses.
    """
    place = Path(os.path.abspath(output))  # `.` has no name and no parent of its own
    folder = place.parent / f"{TEMPORARY}{hashlib.sha256(os.fsencode(place.name)).hexdigest()[:12]}"
    if os.path.lexists(output) and (output.is_symlink() or not output.is_dir() or any(output.iterdir())):
        if folder.is_dir():  # of a process killed after its last step
            with _emptied(folder, place):
                pass
        raise NeecoError(f"{output}: already exists; choose another --output or remove it")
    with new_folder(place.parent), _emptied(folder, place):
        yield folder
        try:
            if place.exists():
                place.rmdir()
            (folder / "capture").rename(place)
        except OSError as error:
            raise cannot_write(place, error) from error


@contextmanager
def _emptied(folder: Path, place: Path) -> Iterator[None]:
    """Hold an empty folder of this process's own, to make `place` in; remove it afterwards."""
    try:
        with own_folder(folder, place):
            _clear(folder)
            try:
                yield
            finally:
                try:
                    _clear(folder)
                except KeyboardInterrupt:  # a second one: nothing is left even so
                    _clear(folder)
                    raise
    finally:
        with suppress(OSError):  # another process's, or gone
            folder.rmdir()


def _clear(folder: Path) -> None:
    """Remove what is in a folder, but not its lock."""
    for entry in folder.iterdir():
        if entry.is_dir():
            shutil.rmtree(entry, ignore_errors=True)
        elif entry.name != LOCK:
            entry.unlink()
