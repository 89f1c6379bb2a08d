"""A D-NeRF-format folder of our own is read as it was drawn, learned from, scored and drawn again."""

from __future__ import annotations

import importlib.util
import json
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
import torch
from PIL import Image

from neeco.capture import check_capture, errors_only, read_capture
from neeco.errors import NeecoError
from neeco.evaluation.evaluate import evaluate_run
from neeco.raster import Camera, rasterize
from neeco.scene.io import load_scene
from neeco.training.config import training_config
from neeco.training.run import load_run
from neeco.training.train import train

SCRIPT = Path(__file__).resolve().parents[2] / "benchmarks" / "blender_format.py"
SIZE = 32


@pytest.fixture(scope="module")
def script() -> ModuleType:
    spec = importlib.util.spec_from_file_location("blender_format", SCRIPT)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def folder(script: ModuleType, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("balls")
    script.generate(path, SIZE, {"train": 8, "val": 2, "test": 2})
    return path


def test_the_cameras_see_the_balls_where_they_are(script: ModuleType, folder: Path) -> None:
    assert errors_only(check_capture(folder)) == []
    capture = read_capture(folder)
    assert [len(capture.split(name)) for name in ("train", "val", "test")] == [8, 2, 2]
    seen = 0
    for frame in capture.frames:
        world_from_camera = frame.camera.world_from_camera.double().numpy()
        with Image.open(frame.image_path) as opened:
            alpha = np.asarray(opened)[..., 3]
        for center, radius, _ in script.balls(frame.state.time):
            x, y, z = np.linalg.inv(world_from_camera)[:3] @ [*center, 1]
            column, row = frame.camera.fx * x / z + frame.camera.cx, frame.camera.fy * y / z + frame.camera.cy
            assert abs(z - 4) < 1.5 + radius
            assert alpha[int(row), int(column)] == 255
            seen += 1
        assert frame.load_image()[0, 0].tolist() == [1, 1, 1]  # transparent, on white
    assert seen == 4 * len(capture.frames)


def test_such_a_folder_is_learned_on_its_white_scored_and_drawn(folder: Path, tmp_path: Path) -> None:
    config = training_config("3dgs", {"iterations": 60}, ["max_tissue_gaussians=2000"])
    run_path = train(folder, tmp_path / "run", config)
    scene = load_scene(run_path / "scene.safetensors")
    assert scene.background == 1.0
    frame = read_capture(folder).split("test")[0]
    with torch.no_grad():
        away = rasterize(scene.at(frame.state), _turned_round(frame.camera)).color
    assert torch.equal(away, torch.ones(SIZE, SIZE, 3))  # where nothing is, the images' white and no floaters
    scores = evaluate_run(load_run(run_path), read_capture(folder), ["test"])["given"]["test"]
    assert scores["frames"] == 2
    assert scores["psnr"] > 12


def _turned_round(camera: Camera) -> Camera:
    pose = camera.world_from_camera.clone()
    pose[:3, :3] = pose[:3, :3] @ torch.diag(torch.tensor([1.0, -1.0, -1.0], dtype=pose.dtype))
    return replace(camera, world_from_camera=pose)


def test_reducing_lets_transparent_pixels_have_no_say(script: ModuleType, tmp_path: Path) -> None:
    source = tmp_path / "source"
    (source / "train").mkdir(parents=True)
    pixels = np.zeros((4, 4, 4), np.uint8)
    pixels[:2, :2] = [[[200, 0, 0, 255], [0, 99, 0, 0]], [[0, 99, 0, 0], [0, 99, 0, 0]]]
    Image.fromarray(pixels, "RGBA").save(source / "train" / "r_0.png")
    frame = {"file_path": "./train/r_0", "time": 0.5, "transform_matrix": np.eye(4).tolist()}
    (source / "transforms_train.json").write_text(json.dumps({"camera_angle_x": 0.7, "frames": [frame]}))
    assert script.reduce_folder(source, tmp_path / "small", 2) == {"train": 1}
    with Image.open(tmp_path / "small/train/r_0.png") as opened:
        assert np.asarray(opened)[0, 0].tolist() == [200, 0, 0, 64]
    assert json.loads((tmp_path / "small/transforms_train.json").read_text())["frames"] == [frame]
    with pytest.raises(NeecoError, match=r"r_0.png: --size: 3 does not divide 4x4 evenly"):
        script.reduce_folder(source, tmp_path / "odd", 3)
    with pytest.raises(NeecoError, match=r"no transforms_train.json"):
        script.reduce_folder(tmp_path, tmp_path / "none", 2)
