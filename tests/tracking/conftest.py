"""One run and its footage for all tests of tracking."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent))

import grasper_world as world

from neeco.capture.model import Capture


@pytest.fixture(scope="session")
def tracked_run(tmp_path_factory: pytest.TempPathFactory) -> world.RecordedRun:
    return world.make_run(tmp_path_factory.mktemp("tracking") / "run")


@pytest.fixture(scope="session")
def footage(tracked_run: world.RecordedRun, tmp_path_factory: pytest.TempPathFactory) -> Capture:
    """Frames in states between the recorded ones."""
    states = [world.moving(k) for k in range(world.FRAMES)]
    return world.record(tracked_run.scene, tmp_path_factory.mktemp("footage"), states, "train")
