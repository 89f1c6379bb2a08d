"""The optional dependencies of `neeco ingest`, imported where they are used."""

from __future__ import annotations

import importlib
import importlib.util
from types import ModuleType

from neeco.errors import NeecoError


def optional_module(name: str) -> ModuleType:
    """The module `name` ("av", "cv2"). Raises NeecoError saying what to install when it is absent."""
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise NeecoError("ingest: needs PyAV, OpenCV and pycolmap; pip install 'neeco[ingest]'") from error


def require_installed(name: str) -> None:
    """Raise the same NeecoError when `name` is absent, without importing it (pycolmap runs in its own process)."""
    if importlib.util.find_spec(name) is None:
        raise NeecoError("ingest: needs PyAV, OpenCV and pycolmap; pip install 'neeco[ingest]'")
