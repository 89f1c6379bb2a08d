"""A video shows the rendered images, along the states and cameras of a file."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from rod_world import CAMERA, FakeRun, rod_state
from scipy.spatial.transform import Rotation

from neeco.base.errors import NeecoError
from neeco.capture.images import to_bytes
from neeco.cli import main
from neeco.labels.drawing import draw
from neeco.synthesis.rendered_views import FPS, View, views_along, write_video
from neeco.synthesis.settings import ImageSettings

av = pytest.importorskip("av", reason="the extra ingest")


def turned(degrees: float):
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3] = torch.from_numpy(Rotation.from_rotvec([0, 0, np.deg2rad(degrees)]).as_matrix())
    return replace(CAMERA, world_from_camera=pose)


KEYS = [View("a", rod_state(x=-6.0, jaw=0.0), turned(0)), View("b", rod_state(x=6.0, jaw=0.8), turned(20))]


def test_a_path_leads_from_the_first_view_to_the_last() -> None:
    first, middle, last = views_along(KEYS, 3)
    assert [view.state.instruments["rod"].joints["jaw_angle"] for view in (first, middle, last)] == [0.0, 0.4, 0.8]
    for view, degrees in ((first, 0), (middle, 10), (last, 20)):
        assert torch.allclose(view.camera.world_from_camera, turned(degrees).world_from_camera)
    with pytest.raises(NeecoError, match="at least two"):
        views_along(KEYS[:1], 3)


def test_the_film_shows_the_rendered_images_in_order(run: FakeRun, tmp_path: Path) -> None:
    views = views_along(KEYS, 4)
    write_video(run.scene, views, tmp_path / "film.mp4", images=ImageSettings(scale=2))
    with av.open(str(tmp_path / "film.mp4")) as film:
        assert film.streams.video[0].codec_context.name == "h264"
        assert film.streams.video[0].average_rate == FPS
        frames = [frame.to_ndarray(format="rgb24").astype(float) for frame in film.decode(video=0)]
    images = [
        to_bytes(draw(run.scene, view.state, view.camera.resized(128, 96)).image).numpy().astype(float)
        for view in views
    ]
    errors = np.array([[np.abs(frame - image).mean() for image in images] for frame in frames])
    assert errors.shape == (4, 4)
    assert list(errors.argmin(1)) == [0, 1, 2, 3]
    assert errors.diagonal().max() < 4  # of 255; colours are stored for two by two pixels


def test_a_missing_package_is_named(run: FakeRun, tmp_path: Path, uninstalled) -> None:
    uninstalled("av")
    with pytest.raises(NeecoError, match=r"--video: needs PyAV; pip install '\.\[ingest\]'"):
        write_video(run.scene, KEYS, tmp_path / "film.mp4")
    assert not list(tmp_path.glob("film*"))


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ([], "render: give exactly one of --output FOLDER and --video FILE.mp4"),
        (["--output", "a", "--video", "b.mp4"], "exactly one of"),
        (["--video", "film.avi"], "--video: film.avi: wrong file name extension"),
        (["--output", "a", "--frames", "9"], "--frames: applies to --video only"),
        (["--video", "b.mp4", "--frames", "1"], "--frames must be 2 to 1,000,000 (got 1)"),
    ],
)
def test_what_does_not_go_together_is_refused(words: list[str], said: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["render", "run", *words]) == 1
    assert said in capsys.readouterr().err
