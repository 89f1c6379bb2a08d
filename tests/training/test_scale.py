"""A run at a share of the images' size learns, is resumed and evaluated like any other."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from neeco.base.errors import NeecoError
from neeco.capture import read_capture
from neeco.cli import main
from neeco.scene.training_views import TrainingViews
from neeco.training.config import training_config
from neeco.training.run import load_run
from neeco.training.train import train

SAMPLE = Path(__file__).resolve().parents[2] / "samples" / "liver-mini"


@pytest.mark.parametrize("scale", [0.5, 0.3])
def test_a_scaled_frame_reads_pixels_of_its_cameras_size(scale: float, tmp_path: Path) -> None:
    frame = read_capture(SAMPLE).frames[0]
    inside = np.zeros((frame.camera.height, frame.camera.width), np.uint8)
    inside[20:150, 31:200] = 255
    Image.fromarray(inside).save(tmp_path / "mask.png")
    small = replace(frame, mask_path=tmp_path / "mask.png").scaled(scale)
    size = (small.camera.height, small.camera.width)
    mask = small.load_mask()
    assert mask is not None
    assert small.load_image().shape[:2] == small.load_image_bytes().shape[:2] == mask.shape == size
    assert mask.float().mean() == pytest.approx(inside.mean() / 255, abs=0.03)  # only pixels whose whole area counts
    assert float(small.load_image().mean()) == pytest.approx(float(frame.load_image().mean()), abs=2e-3)


def test_a_frame_scaled_twice_still_reads_its_file() -> None:
    frame = read_capture(SAMPLE).frames[0].scaled(0.5).scaled(0.5)
    assert frame.load_image().shape == (frame.camera.height, frame.camera.width, 3) == (48, 60, 3)


def test_pixels_scaled_on_reading_and_afterwards_are_the_same() -> None:
    frames = read_capture(SAMPLE).frames[:2]
    read, scaled = TrainingViews.read(frames, 0.5), TrainingViews.read(frames).scaled(0.5)
    assert all(torch.equal(*pair) for pair in zip(read.images, scaled.images, strict=True))
    assert read.frames == scaled.frames


def test_a_kinematic_run_at_a_fifth_of_the_size_ends(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = tmp_path / "run"
    words = ["--scale", "0.2", "--iterations", "40", "--set", "deformation.carving.tissue_steps=100"]
    assert main(["train", str(SAMPLE), "--output", str(run), *words]) == 0
    assert load_run(run).scene.diagnostics["iterations"] == 40
    assert main(["render", str(run), "--output", str(tmp_path / "rendered")]) == 0
    assert Image.open(next((tmp_path / "rendered" / "test").glob("*_mask.png"))).size == (240, 192)


@pytest.mark.parametrize("scale", [0.004, 0.05])
def test_a_scale_that_leaves_too_few_pixels_is_refused(scale: float, tmp_path: Path) -> None:
    with pytest.raises(NeecoError, match=r"--scale: .* leaves images .* give at least 0\.07"):
        train(SAMPLE, tmp_path / "run", training_config("kinematic", {"iterations": 5, "scale": scale}))
    assert not (tmp_path / "run").exists()
