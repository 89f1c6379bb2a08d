"""The optional dependencies of `neeco ingest`, imported where they are used."""

from __future__ import annotations

import importlib
from types import ModuleType

from neeco.errors import NeecoError


def optional_module(name: str) -> ModuleType:
    """The module `name` ("av", "cv2"). Raises NeecoError saying what to install when it is absent."""
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise NeecoError("ingest: needs PyAV, OpenCV and pycolmap; pip install 'neeco[ingest]'") from error
