"""Coarse to fine, and runs at a share of the images' size: sizes that the spectrum asks for, views, limits, cameras."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from torch import Tensor

from neeco.base.errors import NeecoError
from neeco.capture import read_capture
from neeco.cli import main
from neeco.geometry.projection import project_world
from neeco.scene.io import load_scene
from neeco.scene.training_views import TrainingViews
from neeco.training.config import training_config
from neeco.training.resolution import Resolution, ResolutionConfig, amplitude_shares, reduced_scales, size_factor
from neeco.training.run import load_run
from neeco.training.train import train

CONFIG = ResolutionConfig(min_side=16, step=2.0, full_size_at=0.5)


def views_of(capture: Path, image: Tensor) -> TrainingViews:
    """One training frame with this image, uint8 [H, W, 3], and a camera of its size."""
    frame = read_capture(capture).split("train")[0]
    resized = replace(frame, camera=frame.camera.resized(image.shape[1], image.shape[0]))
    return TrainingViews((resized,), (image,), (None,))


def noise(side: int) -> Tensor:
    generator = torch.Generator().manual_seed(0)
    return torch.randint(0, 256, (side, side, 3), generator=generator, dtype=torch.uint8)


def test_sizes_double_from_the_smallest_that_is_large_enough() -> None:
    assert reduced_scales(256, CONFIG) == [1 / 16, 1 / 8, 1 / 4, 1 / 2]
    assert reduced_scales(31, CONFIG) == []
    assert reduced_scales(8, CONFIG) == []


def test_smooth_images_lose_nothing_by_reduction_and_noise_in_proportion_to_its_pixels(capture: Path) -> None:
    wave = torch.sin(torch.arange(64) * (2 * torch.pi * 3 / 64)) * 100 + 128  # 3 periods: 6 px hold it
    smooth = wave.round().to(torch.uint8)[None, :, None].expand(64, 64, 3).contiguous()
    kept = amplitude_shares(views_of(capture, smooth), [1 / 16, 1 / 4])
    assert kept[0] < 0.1
    assert kept[1] > 0.9
    kept = amplitude_shares(views_of(capture, noise(64)), [1 / 4, 1 / 2])
    assert kept == pytest.approx([1 / 16, 1 / 4], rel=0.25)


def test_sizes_grow_over_the_coarse_part_of_the_run_as_the_spectrum_says(capture: Path) -> None:
    resolution = Resolution(CONFIG, views_of(capture, noise(64)))
    found = [resolution.scale(progress / 1000) for progress in range(1001)]
    assert found == sorted(found)
    assert set(found) == {1 / 4, 1 / 2, 1.0}
    assert found.index(1.0) == 500
    assert found.index(0.5) == pytest.approx(125, rel=0.2)  # noise: a quarter of what twice the size keeps
    # positions slow down with the pixels rendered: half of the run at full size is all but a few of them
    drawn = [resolution.rendered_share(progress / 10) for progress in range(11)]
    assert drawn == sorted(drawn)
    assert (drawn[0], drawn[10]) == (0.0, 1.0)
    share = sum(resolution.scale(progress / 1000) ** 2 for progress in range(500)) / 500  # of the first half's pixels
    assert drawn[5] == pytest.approx(share / (share + 1), abs=0.01)
    assert resolution.limit_at(0.0, 1000) == 250
    assert resolution.limit_at(0.9, 1000) == 1000


def test_gaussians_of_larger_images_grow_from_smaller_gradients(capture: Path) -> None:
    small = Resolution(ResolutionConfig(), views_of(capture, noise(256)))
    assert small.threshold_at(0.5, 2e-4) == 2e-4
    large = Resolution(replace(CONFIG, min_side=512), views_of(capture, noise(1024)))
    more = size_factor(1024**2, CONFIG)
    assert large.threshold_at(1.0, 2e-4) == pytest.approx(2e-4 / more**0.5)
    assert large.threshold_at(0.0, 2e-4) == pytest.approx(2e-4 / size_factor(512**2, CONFIG) ** 0.5)


@pytest.mark.parametrize(
    ("method", "changes", "stop"),
    [
        ("kinematic", [], 0.775),
        ("3dgs", [], 0.5),
        ("3dgs", ["resolution.full_size_at=0.6"], 0.8),
        ("kinematic", ["density_stop=0.3"], 0.3),
    ],
)
def test_gaussians_grow_until_half_of_what_is_left_at_full_size(method: str, changes: list[str], stop: float) -> None:
    assert training_config(method, {}, changes).growth_stop == pytest.approx(stop)


def test_without_a_coarse_part_images_always_have_their_size(capture: Path) -> None:
    assert Resolution(ResolutionConfig(), views_of(capture, noise(512))).scale(0.0) == 1.0


def test_reduced_views_are_averages_under_cameras_that_see_the_same(capture: Path) -> None:
    image = noise(64)
    mask = torch.ones(64, 64, dtype=torch.bool)
    mask[10, 20] = False
    full = replace(views_of(capture, image), masks=(mask,))
    half = full.scaled(0.5)
    means = image.float().reshape(32, 2, 32, 2, 3).mean((1, 3))
    assert float((half.images[0].float() - means).abs().max()) <= 0.5 + 1e-3
    assert half.masks[0] is not None
    assert (~half.masks[0]).nonzero().tolist() == [[5, 10]]  # a pixel counts where all that it averages does
    points = torch.tensor([[1.0, 2.0, 60.0], [-5.0, 3.0, 90.0]], dtype=torch.float64)
    places = [project_world(points, views.frames[0].camera)[0] for views in (full, half)]
    assert torch.allclose(places[0], 2 * places[1])
    assert full.scaled(1.0) is full


def test_limits_follow_the_number_of_pixels_unless_given() -> None:
    config = training_config("kinematic", {})
    assert config.gaussian_limits(100) == config.gaussian_limits(320 * 256) == (20_000, 4_000)
    assert config.gaussian_limits(16 * 320 * 256) == (80_000, 16_000)
    assert training_config("kinematic", {"max_tissue_gaussians": 70}).gaussian_limits(1e6)[0] == 70


def test_what_is_learned_from_reduced_images_is_drawn_at_the_recorded_size(capture: Path, tmp_path: Path) -> None:
    notes: list[str] = []
    config = training_config("3dgs", {"iterations": 2, "scale": 0.5})
    run = train(capture, tmp_path / "run", config, progress=lambda row: notes.append(row.note))
    scene = load_scene(run / "scene.safetensors")
    recorded = read_capture(capture).split("train")[0].camera
    half = f"{round(recorded.width / 2)}x{round(recorded.height / 2)}"
    assert any(f"images of {half};" in note and "GB of memory" in note for note in notes)
    assert scene.recorded.cameras[0].width == recorded.width
    assert scene.recorded.as_learned(recorded).learned_fx == pytest.approx(recorded.fx / 2)


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
    words = ["--scale", "0.2", "--iterations", "40", "--set", "deformation.carving.tissue_steps=30"]
    assert main(["train", str(SAMPLE), "--output", str(run), *words]) == 0
    assert load_run(run).scene.diagnostics["iterations"] == 40
    assert main(["render", str(run), "--output", str(tmp_path / "rendered")]) == 0
    assert Image.open(next((tmp_path / "rendered" / "test").glob("*_mask.png"))).size == (240, 192)


@pytest.mark.parametrize("scale", [0.004, 0.05])
def test_a_scale_that_leaves_too_few_pixels_is_refused(scale: float, tmp_path: Path) -> None:
    with pytest.raises(NeecoError, match=r"--scale: .* leaves images .* give at least 0\.07"):
        train(SAMPLE, tmp_path / "run", training_config("kinematic", {"iterations": 5, "scale": scale}))
    assert not (tmp_path / "run").exists()
