"""PLUS sequences for tests, by `benchmarks/rendered/pluswriter.py`."""

from __future__ import annotations

import importlib.util
import sys
from types import ModuleType

from rendered_truth import BENCHMARKS


def _loaded() -> ModuleType:
    if "neeco_pluswriter" not in sys.modules:
        spec = importlib.util.spec_from_file_location("neeco_pluswriter", BENCHMARKS / "rendered" / "pluswriter.py")
        assert spec is not None
        assert spec.loader is not None
        module = importlib.util.module_from_spec(spec)
        sys.modules[spec.name] = module
        spec.loader.exec_module(module)
    return sys.modules["neeco_pluswriter"]


frame_fields, write_mha, write_nrrd = (getattr(_loaded(), name) for name in ("frame_fields", "write_mha", "write_nrrd"))
