"""One run for all tests of the viewer, and a browser for those that need one."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from viewer_page import CHROMIUM, SOFTWARE
from viewer_world import grasper_scene, write_recorded_images, write_run

from neeco.viewer.server import ViewerServer


@pytest.fixture(scope="session")
def made_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished run; tests that change its folder take a copy."""
    root = tmp_path_factory.mktemp("viewer")
    scene = grasper_scene()
    return write_run(scene, root / "run", write_recorded_images(scene, root / "capture"))


@pytest.fixture
def serve() -> Iterator[Callable[..., ViewerServer]]:
    """Starts servers, which end with the test."""
    started: list[ViewerServer] = []

    def start(run: Path, **options: Any) -> ViewerServer:
        viewer = ViewerServer(run, **options)
        started.append(viewer)
        return viewer

    yield start
    for viewer in started:
        viewer.stop()


@pytest.fixture(scope="session")
def chromium() -> Iterator[Any]:
    """A browser; skipped where there is none."""
    playwright = pytest.importorskip("playwright.sync_api")
    if not Path(CHROMIUM).exists():
        pytest.skip(f"needs Chromium at {CHROMIUM}")
    with playwright.sync_playwright() as started:
        browser = started.chromium.launch(executable_path=CHROMIUM, args=SOFTWARE, headless=True)
        yield browser
        browser.close()


@pytest.fixture
def context(chromium: Any) -> Iterator[Any]:
    """Cookies of its own."""
    fresh = chromium.new_context()
    yield fresh
    fresh.close()
