"""The method that docs/adding-a-method.md makes works as the page stands: found, trained, stored, read back, drawn."""

from __future__ import annotations

import math
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from capture_files import write_capture

from neeco.base.errors import NeecoError
from neeco.base.settings import plain
from neeco.capture.images import write_image
from neeco.capture.model import Capture, Frame, PointCloud, State
from neeco.capture.writer import write_capture as write_folder
from neeco.evaluation.evaluate import evaluate_run
from neeco.raster import Camera, Gaussians, rasterize
from neeco.scene.io import load_scene
from neeco.training.config import training_config
from neeco.training.run import load_run
from neeco.training.train import train

PAGE = Path(__file__).resolve().parents[2] / "docs" / "adding-a-method.md"
PERIOD = 2.0  # s


@pytest.fixture(autouse=True)
def breathing(methods_folder: Path) -> None:
    """The page's only block of Python as a file of `methods/`."""
    (code,) = re.findall(r"^```python\n(.*?)^```", PAGE.read_text(encoding="utf-8"), re.DOTALL | re.MULTILINE)
    (methods_folder / "breathing_tissue.py").write_text(code, encoding="utf-8")


def test_it_trains_and_comes_back_from_disk_as_it_was(tmp_path: Path) -> None:
    config = training_config("breathing", {"iterations": 12}, ["deformation.period=3"])
    capture = write_capture(tmp_path / "capture", instruments=False)
    first, again = (train(capture, tmp_path / name, config) / "scene.safetensors" for name in ("run", "again"))
    scene, same = load_scene(first), load_scene(again)
    assert scene.method == "breathing"
    assert plain(scene.settings) == {"period": 3.0, "steadiness": 1e-4}
    for name, parameter in scene.deformation.named_parameters():
        start = {"waves": 0.0, "log_period": math.log(3)}[name]
        assert torch.equal(parameter, same.deformation.get_parameter(name)), name
        assert bool((parameter != start).all()), name
    share = scene.canonical.extras["breathing_share"]
    assert torch.equal(share, same.canonical.extras["breathing_share"])
    distance = (scene.canonical.means - scene.canonical.means.mean(0)).norm(dim=1)
    assert float(torch.corrcoef(torch.stack([share, distance]))[0, 1]) < -0.8  # as `begin` had it
    assert scene.diagnostics["breathing_period_s"] == pytest.approx(float(scene.deformation.log_period.exp()), abs=1e-3)
    state, camera = scene.recorded.states[3], scene.recorded.cameras[3]
    with torch.no_grad():
        drawn = rasterize(scene.at(state), camera).color
        later = rasterize(scene.at(replace(state, time=state.time + 1.4)), camera).color
        assert torch.equal(drawn, rasterize(same.at(state), camera).color)
    assert not torch.equal(drawn, later)


def test_its_setting_is_checked_and_other_fields_are_refused() -> None:
    with pytest.raises(NeecoError, match=r"deformation.perod: method breathing has no such field; it has period"):
        training_config("breathing", {}, ["deformation.perod=3"])
    with pytest.raises(NeecoError, match=r"deformation.period: 'slow' is not a number"):
        training_config("breathing", {}, ["deformation.period=slow"])
    with pytest.raises(NeecoError, match=r"deformation.period: -1 s is no time to breathe"):
        training_config("breathing", {}, ["deformation.period=-1"])


def test_its_share_is_learned_and_its_end_is_told(tmp_path: Path) -> None:
    told: list[str] = []
    capture = write_capture(tmp_path / "capture", instruments=False)
    config = training_config("breathing", {"iterations": 12}, ["deformation.steadiness=1.0e4", "density_start=100"])
    run = train(capture, tmp_path / "run", config, progress=lambda row: told.append(row.note))
    scene = load_scene(run / "scene.safetensors")
    assert told[-1] == f"breathing: one breath takes {float(scene.deformation.log_period.exp()):.2f} s"
    distance = (scene.canonical.means - scene.canonical.means.mean(0)).norm(dim=1)
    began = 2 - 3 * distance / scene.deformation.size
    fallen = began - scene.canonical.extras["breathing_share"]
    assert float(fallen.median()) == pytest.approx(12 * 2e-2, rel=0.1)  # Adam's rate, every step


def test_it_beats_a_still_scene_where_tissue_breathes(tmp_path: Path) -> None:
    capture = write_breathing(tmp_path / "capture")
    scores = {}
    for name, assignments in (("breathing", ["deformation.period=2.1"]), ("3dgs", [])):
        config = training_config(name, {"iterations": 150}, assignments)
        run = load_run(train(capture, tmp_path / name, config))
        scores[name] = evaluate_run(run, run.capture(), ["test"])["given"]["test"]["psnr"]
    assert scores["breathing"] > scores["3dgs"] + 3
    learned = load_scene(tmp_path / "breathing" / "scene.safetensors").deformation
    assert float(learned.log_period.exp()) == pytest.approx(PERIOD, rel=0.05)


def write_breathing(root: Path) -> Path:
    """16 frames of 48x36, every fourth of them test: blobs that sway by 5 mm, seen by a camera that goes about."""
    rng = np.random.default_rng(3)
    points = torch.from_numpy(rng.uniform([-30, -22, -4], [30, 22, 4], (250, 3))).float()
    colors = torch.from_numpy(rng.uniform(0, 1, (250, 3))).float()
    share = torch.exp(-points.square().sum(1) / (2 * 20.0**2))[:, None]
    (root / "raw").mkdir(parents=True)
    frames = []
    for k in range(16):
        pose = torch.eye(4, dtype=torch.float64)
        pose[:3, 3] = torch.tensor([5 * math.sin(2.1 * k), 4 * math.cos(1.3 * k), -80.0])
        camera = Camera(pose, 56.0, 56.0, 24.0, 18.0, 48, 36)
        time = 0.17 * k
        sway = torch.tensor([5.0, -3.0, 0.0]) * math.sin(2 * math.pi * time / PERIOD + 0.6)
        gaussians = Gaussians(
            points + share * sway,
            torch.tensor([1.0, 0, 0, 0]).repeat(250, 1),
            torch.full((250, 3), 2.0),
            torch.full((250,), 0.9),
            (colors[:, None] - 0.5) / 0.28209479177387814,
        )
        write_image(root / "raw" / f"{k:02d}.png", rasterize(gaussians, camera).color)
        split = "test" if k % 4 == 2 else "train"
        frames.append(Frame(root / "raw" / f"{k:02d}.png", camera, State({}, time), split))
    cloud = PointCloud(points.numpy(), colors.numpy())
    write_folder(Capture(root, tuple(frames), (), cloud), root / "capture")
    return root / "capture"
