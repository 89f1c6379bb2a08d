"""Bags for tests; who imports this is skipped where rosbags is absent."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

pytest.importorskip("rosbags")

from bagwriter import KINDS, START, BagWriter

from neeco.base.errors import NeecoError
from neeco.ingest.readers import RecordingFormat, format_of

__all__ = ["KINDS", "START", "BagWriter", "known", "refusal"]


def known(path: Path) -> RecordingFormat:
    """The format of a bag."""
    found = format_of(path)
    assert found is not None
    return found


def refusal(action: Callable[[], object]) -> str:
    """The one line in which an action is refused."""
    with pytest.raises(NeecoError) as caught:
        action()
    assert "\n" not in str(caught.value)
    return str(caught.value)
