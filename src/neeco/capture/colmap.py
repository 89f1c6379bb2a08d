"""Read COLMAP sparse models, binary and text."""

from __future__ import annotations

from pathlib import Path

from neeco.capture.parsed import Parsed
from neeco.capture.problems import Report


def find_model(root: Path) -> Path | None:
    """The folder of a capture that holds a COLMAP model, or None."""
    return None


def parse_colmap(model: Path, root: Path, report: Report) -> Parsed:
    raise NotImplementedError
