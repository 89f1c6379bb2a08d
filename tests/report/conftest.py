import sys
from datetime import UTC, datetime
from pathlib import Path

import pytest

from neeco.report import page

sys.path.insert(0, str(Path(__file__).parent))


class Noon(datetime):
    @classmethod
    def now(cls, tz=None):
        return cls(2026, 1, 1, 12, tzinfo=UTC)


@pytest.fixture
def noon(monkeypatch):
    """Pages are written at one fixed time."""
    monkeypatch.setattr(page, "datetime", Noon)
