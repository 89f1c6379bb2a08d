"""The period with which tissue moves is found from the images, and its motion learned."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from capture_files import train_interrupted

from neeco.capture.model import Frame, State
from neeco.methods.breathing import BREATHING, Breathing, find_breathing, find_period
from neeco.methods.static import Static
from neeco.methods.tissue_fit import fit_tissue
from neeco.raster import Camera, rasterize
from neeco.scene import GaussianScene, Recorded
from neeco.scene.canonical import seed_gaussians
from neeco.scene.training_views import TrainingViews
from neeco.training.config import training_config

PERIOD, SWING = 3.1, (1.0, 0.6, 2.0)  # s, mm
CAMERA = Camera(torch.eye(4, dtype=torch.float64), fx=60.0, fy=60.0, cx=32.0, cy=24.0, width=64, height=48)


def breath(times: np.ndarray, period: float = PERIOD) -> np.ndarray:
    """[F, 3] mm, with a pause."""
    angle = 2 * np.pi * times / period
    return (np.sin(angle) + 0.3 * np.cos(2 * angle))[:, None] * np.array(SWING)


@pytest.mark.parametrize("start", [0.0, 1.7e9])
def test_the_period_is_found_at_irregular_times_in_any_order(start: float) -> None:
    rng = np.random.default_rng(0)
    times = rng.permutation(np.sort(rng.uniform(0, 9, 120)))
    found = find_period(start + times, breath(times) + 0.7 * rng.standard_normal((120, 3)) + [4.0, 5.0, 6.0])
    assert found is not None
    assert found.period == pytest.approx(PERIOD, rel=0.01)
    assert found.explained > 0.6
    assert found.swing.shape == (2 * BREATHING.n_harmonics, 3)


@pytest.mark.parametrize("kind", ["noise", "drift", "short", "faint"])
def test_no_period_is_found_where_there_is_none(kind: str) -> None:
    rng = np.random.default_rng(1)
    times = np.arange(200) / 20
    noise = rng.standard_normal((200, 3))
    shifts = {
        "noise": noise,
        "drift": 0.2 * noise.cumsum(0),
        "short": breath(times, 8.0),  # not even two breaths
        "faint": 0.05 * breath(times),
    }[kind]
    assert find_period(times, shifts) is None


def wall(moving: bool) -> tuple[GaussianScene, TrainingViews]:
    """A textured wall at rest, and 40 images of it at irregular times over three breaths, some in other light."""
    generator = torch.Generator().manual_seed(2)
    places = torch.rand(500, 3, generator=generator) * torch.tensor([130.0, 100.0, 10.0]) + torch.tensor(
        [-65, -50, 95.0]
    )
    colors = 0.2 + 0.6 * torch.rand(500, 3, generator=generator)
    tissue = seed_gaussians(places, colors, torch.full((500,), 3.0), opacity=0.8)
    scene = GaussianScene("3dgs", tissue, Static(), (), Recorded(), places.mean(0))
    times = np.sort(np.random.default_rng(3).uniform(0, 3 * PERIOD, 40))
    shifts = torch.from_numpy(breath(times) * moving).float()
    frames, images = [], []
    for k, time in enumerate(times):
        tissue = scene.canonical.map(lambda tensor: tensor.clone())
        tissue.means.add_(shifts[k])
        drawn = rasterize(
            GaussianScene("3dgs", tissue, Static(), (), Recorded(), places.mean(0)).at(State()), CAMERA
        ).color
        drawn = drawn.detach() * (1.05 if k % 3 else 0.95)
        images.append((drawn.clamp(0, 1) * 255).round().to(torch.uint8))
        frames.append(Frame(Path(f"{k:06d}.png"), CAMERA, State(time=float(time)), "train"))
    return scene.requires_grad_(False), TrainingViews(tuple(frames), tuple(images), (None,) * len(frames))


def test_breathing_is_found_in_images_and_learned() -> None:
    scene, views = wall(moving=True)
    begun = find_breathing(scene, views)
    assert begun is not None
    breathing, found = begun
    assert found.period == pytest.approx(PERIOD, rel=0.03)
    config = training_config("kinematic", {})

    @torch.no_grad()
    def error(tissue: GaussianScene) -> float:
        drawn = [rasterize(tissue.at(frame.state), CAMERA).color for frame in views.frames]
        return sum(float((color - views.target(k)).square().mean()) for k, color in enumerate(drawn))

    still, breathes = (error(fit_tissue(scene, views, config, 80, breathing=begin)) for begin in (None, breathing))
    assert breathes < 0.7 * still


def test_still_tissue_does_not_breathe() -> None:
    assert find_breathing(*wall(moving=False)) is None


def test_an_interrupted_run_goes_on_breathing(capture: Path, tmp_path: Path, registered) -> None:
    @registered
    class Breathes(Static):
        method = "breathes"

        def begin(self, training: object) -> None:
            tissue = 10 * torch.randn(60, 3, generator=torch.Generator().manual_seed(0))
            self.start_breathing(Breathing.of(tissue, 0.2, torch.full((2 * BREATHING.n_harmonics, 3), 0.5), 0.1))

    short = ["density_start=10", "log_interval=5", "checkpoint_interval=10"]
    config = training_config("breathes", {"iterations": 30}, short)
    train_interrupted(capture, tmp_path, config, 15)
