from __future__ import annotations

import sys
from pathlib import Path

import pytest
import torch

sys.path.insert(0, str(Path(__file__).parent))

from capture_files import write_capture


@pytest.fixture(autouse=True)
def one_thread() -> None:
    """Threads that share a small operation wait for each other longer than they work."""
    torch.set_num_threads(1)


@pytest.fixture
def capture(tmp_path: Path) -> Path:
    """A small capture of two splits on disk."""
    return write_capture(tmp_path / "capture")
