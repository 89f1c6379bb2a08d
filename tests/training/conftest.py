from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent))

from capture_files import write_capture

import neeco.methods
from neeco.scene.method_registry import methods


@pytest.fixture
def methods_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A folder whose files are found as those of `methods/` are."""
    (tmp_path / "methods").mkdir()
    monkeypatch.setattr(neeco.methods, "__path__", [*neeco.methods.__path__, str(tmp_path / "methods")])
    methods.cache_clear()
    yield tmp_path / "methods"
    methods.cache_clear()
    for file in (tmp_path / "methods").glob("*.py"):
        del sys.modules[f"neeco.methods.{file.stem}"]


@pytest.fixture
def capture(tmp_path: Path) -> Path:
    """A small capture of two splits on disk."""
    return write_capture(tmp_path / "capture")
