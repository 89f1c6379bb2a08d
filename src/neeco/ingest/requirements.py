"""The optional dependencies of `neeco ingest`, imported where they are used."""

from __future__ import annotations

import importlib.util

from neeco.errors import NeecoError


def require_installed(name: str) -> None:
    """Raise NeecoError saying what to install when `name` ("av", "pycolmap") is absent; imports nothing."""
    if importlib.util.find_spec(name) is None:
        raise NeecoError("ingest: needs PyAV and pycolmap; pip install 'neeco[ingest]'")
