"""The practical preset of `neeco` from recorded images to labels: it begins on the instrument or says why not."""

from __future__ import annotations

import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from capture_files import train_interrupted, write_grasper

from neeco.base.errors import NeecoError
from neeco.training.config import training_config
from neeco.training.run import load_run
from neeco.training.train import train

SHORT = ["density_start=10", "log_interval=1", "checkpoint_interval=20", "deformation.carving.tissue_steps=100"]
SMALL = ["deformation.preset=practical", "deformation.width=16", "deformation.depth=2", *SHORT]
CONFIG = training_config("nps", {"iterations": 60}, SMALL)


@pytest.fixture(scope="module")
def grasper(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_grasper(tmp_path_factory.mktemp("grasper") / "capture", sizes=((80, 64), (64, 72)))


def test_runs_repeat_and_resume_and_label_what_moves(grasper: Path, tmp_path: Path) -> None:
    first, _ = train_interrupted(grasper, tmp_path, CONFIG, 35)
    scene = load_run(first).scene
    moved = scene.deltas(scene.recorded.states[0]).means.norm(dim=1)
    channels = scene.deformation.label_channels(scene.canonical)[:, 0]
    assert 0 < int((channels > 0.5).sum()) < len(channels)
    assert float(moved[channels > 0.5].median()) > 5 * float(moved[channels < 0.5].median())


def test_a_recording_in_which_nothing_moves_with_the_poses_is_refused(grasper: Path, tmp_path: Path) -> None:
    capture = tmp_path / "capture"
    shutil.copytree(grasper, capture)
    for path in (capture / "images").iterdir():
        cv2.imwrite(str(path), np.full_like(cv2.imread(str(path)), 128))
    with pytest.raises(NeecoError, match="nothing in the images moves with its recorded pose") as raised:
        train(capture, tmp_path / "run", CONFIG)
    assert "\n" not in str(raised.value)
    assert "in recording.yaml state camera_from_base" in str(raised.value)
