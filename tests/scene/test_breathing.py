"""Tissue that breathes: how it moves, and how it is stored."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch
from safetensors import safe_open
from safetensors.torch import save_file
from scene_worlds import TISSUE, grasper_state, make_scene, pose_of

from neeco.base.errors import NeecoError
from neeco.geometry.camera import Camera
from neeco.methods.breathing import BREATHING, Breathing
from neeco.scene import GaussianScene
from neeco.scene.io import load_scene, save_scene

CAMERAS = [
    Camera(torch.eye(4) + torch.eye(4)[0][:, None] * torch.eye(4)[3] * x, 100, 100, 32, 32, 64, 64) for x in (0.0, 5.0)
]
PERIOD, LATE = 4.0, 1.7e9  # s; clocks may count from 1970


def breathing(points: torch.Tensor) -> Breathing:
    """One whose control points move differently."""
    made = Breathing.of(points, PERIOD, torch.zeros(2 * BREATHING.n_harmonics, 3), LATE)
    with torch.no_grad():
        made.swings += torch.randn(made.swings.shape, generator=torch.Generator().manual_seed(1))
    return made


def breathing_scene() -> GaussianScene:
    scene = make_scene("kinematic")
    scene.deformation.start_breathing(breathing(scene.canonical.means[:TISSUE]))
    scene.diagnostics["breathing"] = {"explained": 0.8}
    return scene.requires_grad_(False)


def test_the_motion_repeats_and_is_zero_on_the_average() -> None:
    points = 30 * torch.randn(40, 3, generator=torch.Generator().manual_seed(0))
    made = breathing(points)
    moved = torch.stack([made(points, LATE + PERIOD * k / 8) for k in range(9)])
    assert moved[0].norm(dim=1).min() > 0.1
    assert torch.allclose(moved[0], moved[8], atol=1e-4)
    assert moved[:8].mean(0).abs().max() < 1e-4
    assert 0 < float(moved.norm(dim=-1).max().detach()) <= made.describe(CAMERAS)["amplitude_mm"] + 0.01


def test_motion_along_the_only_view_is_no_amplitude() -> None:
    points = torch.tensor([[0.0, 0.0, 100.0], [1.0, 0.0, 100.0], [0.0, 1.0, 100.0]])
    swing = torch.tensor([[3.0, 0.0, 40.0], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
    told = Breathing.of(points, PERIOD, swing, 0.0).describe(CAMERAS[:1])
    assert "amplitude_mm" not in told
    assert 2.5 < told["amplitude_across_mm"] < 3.5


def test_gradients_of_swings_and_period_are_those_of_finite_differences() -> None:
    points = 30 * torch.randn(12, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    made = breathing(points).double()

    def displaced(swings: torch.Tensor, period: torch.Tensor) -> torch.Tensor:
        learned = {"swings": swings, "period": period}
        return torch.func.functional_call(made, learned, (points, LATE + 1.3))

    assert torch.autograd.gradcheck(displaced, (made.swings, made.period))


def test_only_the_tissue_breathes_and_what_was_stored_does_so_again(tmp_path: Path) -> None:
    scene, still = breathing_scene(), make_scene("kinematic")
    states = [grasper_state(pose_of(0.1, 0.2, 0.1, 1, 2, 60), time=LATE + time) for time in (0.3, 1.9)]
    posed = [scene.at(state).means for state in states]
    assert (posed[0] - posed[1])[:TISSUE].norm(dim=1).min() > 0.05
    assert (posed[0][TISSUE:] == still.at(states[0]).means[TISSUE:]).all()
    save_scene(scene, tmp_path / "breathing.safetensors")
    loaded = load_scene(tmp_path / "breathing.safetensors")
    assert isinstance(loaded, GaussianScene)
    assert all((loaded.at(state).means == means).all() for state, means in zip(states, posed, strict=True))


def test_still_scenes_store_nothing_of_it_and_impossible_periods_are_refused(tmp_path: Path) -> None:
    assert not [name for name in make_scene("kinematic").state_dict() if "breathing" in name]
    path = tmp_path / "breathing.safetensors"
    save_scene(breathing_scene(), path)
    with safe_open(path, "pt") as stream:
        metadata, tensors = stream.metadata(), {name: stream.get_tensor(name) for name in stream.keys()}  # noqa: SIM118
    assert json.loads(metadata["neeco"])["diagnostics"]["breathing"] == {"explained": 0.8}
    tensors["module.deformation.breathing.period"] = torch.zeros(())
    save_file(tensors, path, metadata)
    with pytest.raises(NeecoError, match="period of 0"):
        load_scene(path)
