"""`--json FILE`."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path

from neeco.errors import NeecoError
from neeco.files import new_folder


@contextmanager
def ready_for_json(path: Path | None) -> Iterator[None]:
    """For the work whose numbers go to `--json`: a place that cannot be written to is told before it, not after.

    Raises NeecoError for a folder, or what has no folder that can be written to.
    """
    if path is not None and path.is_dir():
        raise NeecoError(f"--json: {path} is a folder; name a file")
    with nullcontext() if path is None else new_folder(path.parent):
        yield
