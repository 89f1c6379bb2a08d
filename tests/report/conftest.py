import sys
from datetime import UTC, datetime
from pathlib import Path

import pytest

from neeco.report import page

sys.path.insert(0, str(Path(__file__).parent))


@pytest.fixture
def noon(monkeypatch):
    """Pages are written at one fixed time."""
    monkeypatch.setattr(page, "now", lambda: datetime(2026, 1, 1, 12, tzinfo=UTC))
