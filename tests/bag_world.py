"""Bags for tests, by `benchmarks/rendered/bagwriter.py`; who imports this is skipped where rosbags is absent."""

from __future__ import annotations

import importlib.util
import sys
from types import ModuleType

import pytest
from rendered_truth import BENCHMARKS

pytest.importorskip("rosbags")


def _loaded() -> ModuleType:
    if "neeco_bagwriter" not in sys.modules:
        spec = importlib.util.spec_from_file_location("neeco_bagwriter", BENCHMARKS / "rendered" / "bagwriter.py")
        assert spec is not None
        assert spec.loader is not None
        module = importlib.util.module_from_spec(spec)
        sys.modules[spec.name] = module
        spec.loader.exec_module(module)
    return sys.modules["neeco_bagwriter"]


BagWriter, KINDS, START = (getattr(_loaded(), name) for name in ("BagWriter", "KINDS", "START"))
