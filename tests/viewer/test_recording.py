"""`neeco view CAPTURE`: what was recorded, before anything is learned from it."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from viewer_page import ViewerPage
from viewer_world import grasper_scene, write_recorded_images

from neeco.capture.images import write_image
from neeco.capture.readers import read_capture
from neeco.cli import main
from neeco.labels.drawing import to_numpy

pytest.importorskip("viser")
from neeco.viewer.recording import RecordingServer, image_behind
from neeco.viewer.views import fitting_view


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_recorded_images(grasper_scene(), tmp_path_factory.mktemp("recorded") / "capture")


@pytest.fixture
def served(root: Path) -> Iterator[RecordingServer]:
    with RecordingServer(root, port=18500) as server:
        yield server


@pytest.mark.parametrize("aspect", [0.5, 1.3, 2.5])
def test_an_image_liesimage_behind_the_scene_where_the_camera_saw_it(root: Path, tmp_path: Path, aspect: float) -> None:
    """A white dot at a pixel is where a pinhole of the window's field of view projects that pixel's ray."""
    frame = read_capture(root).frames[0]
    camera = replace(frame.camera, fx=60.0, fy=66.0, cx=30.0, cy=25.0)
    image = np.zeros((camera.height, camera.width, 3), np.uint8)
    cv2.circle(image, (40, 20), 2, (255, 255, 255), -1)
    write_image(tmp_path / "dot.png", torch.from_numpy(image) / 255)
    shown = image_behind(replace(frame, image_path=tmp_path / "dot.png", camera=camera), aspect)
    height, width = shown.shape[:2]
    assert width / height == pytest.approx(aspect, rel=0.01)
    focal = height / 2 / math.tan(fitting_view(camera, aspect) / 2)
    v, u = np.nonzero(shown[..., 0] > 127)
    ray = (40.5 - camera.cx) / camera.fx, (20.5 - camera.cy) / camera.fy
    assert u.mean() + 0.5 == pytest.approx(width / 2 + focal * ray[0], abs=1)
    assert v.mean() + 0.5 == pytest.approx(height / 2 + focal * ray[1], abs=1)


def test_a_capture_is_not_exported(root: Path, tmp_path: Path, capsys) -> None:
    assert main(["view", str(root), "--export", str(tmp_path / "page.html")]) == 1
    assert capsys.readouterr().err.count("\n") == 1
    assert not (tmp_path / "page.html").exists()


def settled(page: ViewerPage) -> np.ndarray:
    page.page.wait_for_timeout(1500)
    return page.screenshot()[50:, :300].astype(float)  # without the panel


@pytest.mark.browser
def test_images_axes_and_tracks_are_shown(served: RecordingServer, root: Path, context: Any) -> None:
    page = ViewerPage(context, served.address)
    until = time.monotonic() + 30
    while not served.sessions:
        assert time.monotonic() < until
        page.page.wait_for_timeout(50)
    (session,) = served.sessions.values()
    page.page.get_by_text("000000, train").wait_for(timeout=30_000)
    first = settled(page)
    red = (0.7 * 255, 0.3 * 255, 0.3 * 255)  # the recorded wall
    assert (np.abs(first - red).sum(-1) < 90).mean() > 0.3
    for frame in (4, 8):
        session.frame.value = frame
        session.show(True)
        settled(page)
        pose = to_numpy(read_capture(root).frames[frame].state.instruments["grasper"].pose)
        assert np.asarray(session.axes["grasper"].position) / served.unit == pytest.approx(pose[:3, 3], abs=1e-3)
        assert f"{frame:06d}, train" in page.text()
    page.drag(150, 200, 260, 240)
    assert (np.abs(settled(page) - red).sum(-1) < 90).mean() < 0.05  # no image where nobody recorded one
    page.press("go to this frame's camera")
    assert (np.abs(settled(page) - red).sum(-1) < 90).mean() > 0.3
    before = settled(page)
    page.tick("tracks")
    assert np.abs(settled(page) - before).max() > 60
