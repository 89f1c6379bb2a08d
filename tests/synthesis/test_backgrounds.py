"""Backgrounds: rendered instruments over images of another operation, with their labels and shadows."""

from __future__ import annotations

import json
import pickle
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from ball_world import ball_scene
from PIL import Image
from rod_world import CAMERA, FakeRun, rod_state
from torch import nn

from neeco.base.errors import NeecoError
from neeco.labels.drawing import draw_layers
from neeco.labels.labellers import CompositedLabels
from neeco.scene import GaussianScene
from neeco.synthesis.dataset import synthesize
from neeco.synthesis.generator import SampleGenerator
from neeco.synthesis.settings import Settings
from neeco.synthesis.tissue_replacement import Appearance, ImageFolder, Layers, split
from neeco.synthesis.torch_datasets import LabelledImages

SETTINGS = Settings(count=3, seed=3, tissue_tolerance_mm=2.0)


def folder_of(path: Path, *colors: tuple[int, int, int], size: tuple[int, int] = (80, 40)) -> str:
    path.mkdir()
    for k, color in enumerate(colors):
        Image.new("RGB", size, color).save(path / f"{k}.png")
    return str(path)


def layers_of(scene: GaussianScene) -> tuple[Layers, torch.Tensor, torch.Tensor]:
    """The rod's layers, its image, and its share of each pixel."""
    state, labeller = rod_state(), CompositedLabels(scene)
    drawing = draw_layers(scene, labeller, state, CAMERA, 0.0)
    gaussians = scene.at(state)
    layers = split(gaussians, labeller.owners(state, gaussians), CAMERA, drawing.image, drawing.share)
    return layers, drawing.image, drawing.share


def shadowed(scene: GaussianScene) -> GaussianScene:
    """The scene with a lamp beside the lens."""
    lit = GaussianScene("rod", scene.canonical, scene.deformation, scene.instruments, scene.recorded, scene.center)
    lit.load_state_dict(scene.state_dict())
    offsets, strengths = torch.zeros_like(lit.shadow_offsets), torch.zeros_like(lit.shadow_strengths)
    offsets[0], strengths[0] = torch.tensor([15.0, 0.0, 0.0]), 0.8
    lit.shadow_offsets, lit.shadow_strengths = nn.Parameter(offsets), nn.Parameter(strengths)
    return lit


@pytest.mark.parametrize("lamp", [False, True])
def test_over_its_own_tissue_an_instrument_looks_as_rendered(scene: GaussianScene, lamp: bool) -> None:
    layers, image, _ = layers_of(shadowed(scene) if lamp else scene)
    assert (layers.over(layers.tissue) - image).abs().mean() < 0.01


def test_the_shadow_falls_on_the_background_and_nowhere_without_a_lamp(scene: GaussianScene) -> None:
    grey = torch.full((CAMERA.height, CAMERA.width, 3), 0.5)
    for lit in (scene, shadowed(scene)):
        layers, _, share = layers_of(lit)
        around = layers.over(grey)[share < 0.02].mean(1) / 0.5
        assert around.median() == pytest.approx(1, abs=0.02)
        assert (around.min() < 0.8) if lit is not scene else (around.min() > 0.95)


def test_half_of_the_images_show_a_background_and_labels_stay(scene: GaussianScene, tmp_path: Path) -> None:
    grey = torch.tensor([100, 100, 100]) / 255
    folder = folder_of(tmp_path / "grey", (100, 100, 100))
    plain, varied = (SampleGenerator.of(scene, replace(SETTINGS, backgrounds=given)) for given in (None, folder))
    kinds = set()
    for index in range(12):
        own, other = plain.draw(index).drawing, varied.draw(index)
        assert torch.equal(own.parts, other.drawing.parts)
        assert torch.equal(own.share, other.drawing.share)
        outside, image = own.share < 0.01, other.drawing.image
        kinds.add(other.facts["background"])
        if other.facts["background"]:
            assert (image[outside] - grey).abs().max() < 0.06
            assert not other.drawing.depth[outside.numpy()].any()
        else:
            assert torch.equal(own.image, image)
    assert kinds == {"0.png", None}


def test_half_of_the_images_take_on_the_colours_of_other_frames_and_labels_stay(scene, tmp_path):
    folder = tmp_path / "frames"
    folder.mkdir()
    colors = np.random.default_rng(0).uniform([0.1, 0.3, 0.2], [0.3, 0.9, 0.4], (60, 80, 3))
    colors[:, :20] = 0  # a border
    Image.fromarray((colors * 255).astype(np.uint8)).save(folder / "a.png")
    plain, matched = (SampleGenerator.of(scene, replace(SETTINGS, match_colors=given)) for given in (None, str(folder)))
    changed = 0
    for index in range(10):
        own, other = plain.draw(index).drawing, matched.draw(index).drawing
        assert torch.equal(own.parts, other.parts)
        if torch.equal(own.image, other.image):
            continue
        changed += 1
        assert other.image.mean((0, 1)).numpy() == pytest.approx(np.array([0.2, 0.6, 0.3]), abs=0.05)
        assert float(other.image[..., 1].std()) == pytest.approx(0.17, abs=0.05)
    assert 0 < changed < 10


def test_instruments_take_on_the_light_of_the_background(scene: GaussianScene) -> None:
    layers, _, share = layers_of(scene)
    dark, inside = layers.tissue * 0.5, share > 0.99
    brightness = [
        Appearance("dark", dark, strength).over_background(layers)[inside].mean() for strength in (0.0, 0.5, 1.0)
    ]
    assert brightness[0] > 1.2 * brightness[1] > 1.4 * brightness[2]


def test_crops_keep_the_shape_of_images_of_any_size(tmp_path: Path) -> None:
    ramp = np.linspace(0, 255, 400).round().astype(np.uint8)
    folder = tmp_path / "wide"
    folder.mkdir()
    Image.fromarray(np.repeat(np.tile(ramp, (50, 1))[..., None], 3, 2)).save(folder / "a.png")
    backgrounds = ImageFolder.of(str(folder), "backgrounds")
    for width, height in ((40, 40), (200, 100), (20, 10)):
        image = backgrounds.crop(0, np.random.default_rng(1), width, height)
        assert image.shape == (height, width, 3)
        spread = float(image.max() - image.min())
        assert 0.6 * width / height * 50 / 400 < spread <= 1.05 * width / height * 50 / 400  # not squeezed


def test_a_data_set_is_the_same_again_and_is_not_continued_with_other_backgrounds(run: FakeRun, tmp_path: Path) -> None:
    folder = folder_of(tmp_path / "plates", (0, 200, 0), (0, 0, 200))
    settings = replace(SETTINGS, backgrounds=folder)
    for name in ("once", "again"):
        synthesize(run, tmp_path / name, settings)  # type: ignore[arg-type]
    for index in range(SETTINGS.count):
        first, second = ((tmp_path / name / f"images/{index:06d}.png").read_bytes() for name in ("once", "again"))
        assert first == second
    assert len(json.loads((tmp_path / "once/dataset.json").read_text())["settings"]["backgrounds"]) == 64
    Image.new("RGB", (80, 40), (9, 9, 9)).save(Path(folder) / "2.png")
    with pytest.raises(NeecoError, match=r"settings.backgrounds: begun with"):
        synthesize(run, tmp_path / "once", settings, resume=True)  # type: ignore[arg-type]


def test_a_wrong_folder_is_told_in_a_line(tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    (tmp_path / "broken").mkdir()
    (tmp_path / "broken/a.png").write_bytes(b"no image")
    folder_of(tmp_path / "icons", (0, 0, 0), size=(16, 16))
    for name, told in (
        ("nowhere", "no such folder"),
        ("empty", "has no image"),
        ("icons", "is smaller than 32 px"),
        ("broken", "a.png"),
    ):
        with pytest.raises(NeecoError, match=told) as error:
            ImageFolder.of(str(tmp_path / name), "backgrounds")
        assert "\n" not in str(error.value)


def test_another_process_gets_the_backgrounds_with_the_scene(tmp_path: Path) -> None:
    folder = folder_of(tmp_path / "plates", (0, 200, 0), (0, 0, 200))
    ball = ball_scene("ball", [(-8, 0, 55), (4, 2, 60)])
    images = LabelledImages(ball, 4, seed=3, tissue_tolerance_mm=2.0, backgrounds=folder, match_colors=folder)
    sent, own = pickle.loads(pickle.dumps(images)), [images[k]["image"] for k in range(4)]
    shutil.rmtree(folder)
    assert all(torch.equal(sent[k]["image"], image) for k, image in enumerate(own))
    assert len({float(image[1, 0, 0]) for image in own}) > 1
