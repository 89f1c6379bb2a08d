"""Paths of a capture stay inside its folder."""

from __future__ import annotations

import os
from pathlib import Path, PureWindowsPath

from neeco.capture.problems import shown
from neeco.errors import NeecoError


def inside(root: Path, folder: Path, text: str) -> Path:
    """The path `text`, taken relative to `folder`, which must lie inside `root` also after following symbolic links.

    Raises NeecoError (without naming the field: the caller does) when it is absolute, leads out or is no path at all.
    """
    if os.path.isabs(text) or PureWindowsPath(text).is_absolute():
        raise NeecoError(f"{shown(text)} is absolute; give a path relative to the capture's folder")
    try:
        path = Path(os.path.normpath(folder / text))
        outside = not path.resolve().is_relative_to(root.resolve())
    except (OSError, RuntimeError, ValueError):
        raise NeecoError(f"{shown(text)} is not a usable path; repair it") from None
    if outside:
        raise NeecoError(f"{shown(text)} leaves the capture's folder; copy the file into it and name it from there")
    return path
