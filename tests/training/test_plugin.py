"""A method, a writer and a model in a package of their own do what ours do; what cannot be loaded is named."""

from __future__ import annotations

import importlib
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from capture_files import write_grasper
from plugin_site import install_plugin

import neeco
from neeco.base.errors import NeecoError
from neeco.capture import read_capture
from neeco.capture.images import write_labels
from neeco.cli import main
from neeco.scene.method_registry import methods
from neeco.training.run import load_run
from neeco.viewer.views import picture, views_of


def test_an_installed_method_trains_evaluates_renders_synthesizes_and_is_viewed(site: Path, tmp_path: Path) -> None:
    install_plugin(site)
    capture, run = write_grasper(tmp_path / "capture", frames=12, sizes=((64, 48),)), tmp_path / "run"
    settings = ["--set", "deformation.carving.tissue_steps=60", "--set", "deformation.carving.seeds=1000"]
    assert (
        main(["train", str(capture), "--method", "rigid", "--output", str(run), "--iterations", "40", *settings]) == 0
    )
    assert main(["evaluate", str(run), "--json", str(tmp_path / "scores.json")]) == 0
    scores = json.loads((tmp_path / "scores.json").read_text())
    assert scores["given"]["test"]["psnr"] > 12
    data = ["--output", str(tmp_path / "data"), "--min-share", "0.0001", "--no-tissue-check", "--force"]
    assert main(["synthesize", str(run), "--count", "6", "--formats", "yolo", "boxlist", *data]) == 0
    boxes = (tmp_path / "data" / "boxlist" / "boxes.csv").read_text().splitlines()
    assert len(boxes) == 7
    assert "boxlist" in json.loads((tmp_path / "data" / "dataset.json").read_text())["formats"]
    assert main(["render", str(run), "--split", "test", "--output", str(tmp_path / "renders")]) == 0
    scene = load_run(run).scene
    for view in views_of(scene, has_images=False):  # of `neeco view`
        picture(scene, scene.recorded.states[0], scene.recorded.cameras[0], view)
    command = [sys.executable, "-c", "from neeco.cli import main; main()", "synthesize", "--help"]
    path = os.pathsep.join([str(site), str(Path(neeco.__file__).parents[1])])
    environment = os.environ | {"PYTHONPATH": path, "COLUMNS": "160"}
    shown = subprocess.run(command, env=environment, capture_output=True, text=True, check=True).stdout
    assert "imagefolder" in shown
    assert "boxlist" in shown
    truth = write_truth(capture)
    words = ["--models", "pixelwise", "--sets", f"made={tmp_path / 'data'}", "--conditions", "made", "--folds", "1"]
    words += ["--num-real", "0", "--steps", "20", "--output", str(tmp_path / "study")]
    assert main(["downstream", str(truth), *words]) == 0
    study = json.loads((tmp_path / "study" / "downstream.json").read_text())
    assert study["models"][0]["name"] == "pixelwise"
    assert "error" not in study["jobs"][0]


def write_truth(capture: Path) -> Path:
    """True masks of the capture's test frames: whatever is dark or white, as its instrument is."""
    for frame in read_capture(capture).split("test"):
        image = frame.load_image()
        mask = ((image.amax(-1) < 0.3) | (image.amin(-1) > 0.7)).to(torch.uint8)
        write_labels(capture / "truth" / "masks" / f"{frame.name}.png", mask)
    return capture


def test_an_entry_point_that_cannot_be_loaded_is_named(site: Path) -> None:
    about = site / "broken-1.0.dist-info"
    about.mkdir(parents=True)
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: broken\nVersion: 1.0\n")
    (about / "entry_points.txt").write_text("[neeco.methods]\nbroken = broken_module:Method\n")
    importlib.invalidate_caches()
    with pytest.raises(
        NeecoError, match=r"broken_module:Method: entry point of broken in neeco.methods cannot be load"
    ):
        methods()
