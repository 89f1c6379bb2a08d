"""Bags for tests, by `benchmarks/rendered/bagwriter.py`; who imports this is skipped where rosbags is absent."""

from __future__ import annotations

import pytest
from rendered_truth import rendered_module

pytest.importorskip("rosbags")


BagWriter, KINDS, START = (getattr(rendered_module("bagwriter"), name) for name in ("BagWriter", "KINDS", "START"))
