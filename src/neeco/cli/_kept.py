"""What a verb says where its work ended early, and what was done is kept."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from neeco.errors import NeecoError
from neeco.raster.devices import device_failure


@contextmanager
def kept(how: str, begun: Path | None = None) -> Iterator[None]:
    """Where Ctrl-C, or a GPU that fails, ends the block, tell `how` to go on: as soon as the file `begun` is there.

    Ctrl-C's own words are kept where it has some. Raises KeyboardInterrupt and NeecoError.
    """
    try:
        yield
    except (KeyboardInterrupt, Exception) as error:
        if begun is not None and not begun.exists():
            raise
        if isinstance(error, KeyboardInterrupt):
            raise KeyboardInterrupt(*(error.args or (how,))) from None
        if failure := device_failure(error):
            raise NeecoError(f"{failure}; {how}") from error
        raise
