"""Captures that appear at their place whole or not at all."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from neeco.errors import NeecoError
from neeco.files import new_folder


@contextmanager
def staged(output: Path) -> Iterator[Path]:
    """A temporary folder beside `output`, on the same disk, gone afterwards whatever happens. What the block leaves in
    its `capture` becomes `output`.

    Raises NeecoError when something other than an empty folder is at `output`, and when the disk refuses.
    """
    if os.path.lexists(output) and (output.is_symlink() or not output.is_dir() or any(output.iterdir())):
        raise NeecoError(f"{output}: exists already; choose another --output or remove it")
    place = Path(os.path.abspath(output))  # `.` has no name and no parent of its own
    with new_folder(place.parent):
        folder = Path(tempfile.mkdtemp(prefix=f".{place.name[:80]}-", dir=place.parent))
        try:
            yield folder
            _move(folder / "capture", place)
        finally:
            shutil.rmtree(folder, ignore_errors=True)


def _move(capture: Path, place: Path) -> None:
    try:
        if place.exists():
            place.rmdir()
        capture.rename(place)
    except OSError as error:
        raise NeecoError(f"{place}: cannot write: {error.strerror or error}") from error
