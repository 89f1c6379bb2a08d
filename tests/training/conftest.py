from __future__ import annotations

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent))

from capture_files import write_capture


@pytest.fixture
def capture(tmp_path: Path) -> Path:
    """A small capture of two splits on disk."""
    return write_capture(tmp_path / "capture")
