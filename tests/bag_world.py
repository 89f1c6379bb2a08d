"""Bags for tests; who imports this is skipped where rosbags is absent."""

from __future__ import annotations

import pytest

pytest.importorskip("rosbags")

from bagwriter import KINDS, START, BagWriter

__all__ = ["KINDS", "START", "BagWriter"]
