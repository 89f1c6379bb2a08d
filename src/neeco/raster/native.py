"""The compiled kernels, or a clear word that they are missing."""

from __future__ import annotations

import importlib
from typing import Any

from neeco.errors import NeecoError


def native() -> Any:
    """The module `neeco._native`. Raises NeecoError when it was never built."""
    try:
        return importlib.import_module("neeco._native")
    except ImportError as error:
        raise NeecoError("neeco._native: the compiled kernels are missing; install with `pip install .`") from error
