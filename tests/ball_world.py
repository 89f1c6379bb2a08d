"""A grey ball before a red wall, and runs of it: scenes of method kinematic that can be written and read."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from rod_world import CAMERA, WALL_MM, FakeRun

from neeco.capture.model import Instrument, InstrumentState, State
from neeco.methods.kinematic.articulation import LINK_LOGITS
from neeco.methods.kinematic.deformation import Kinematic
from neeco.scene import CanonicalGaussians, GaussianScene, Recorded
from neeco.scene.io import save_scene

RADIUS = 6.0  # mm, of a ball
SKIN = 1.0  # mm, by which its Gaussians reach out of the sphere that their middles lie on


def at(x: float, y: float, z: float) -> torch.Tensor:
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, 3] = torch.tensor([x, y, z])
    return pose


def ball_state(name: str, x: float, y: float, z: float) -> State:
    return State({name: InstrumentState(at(x, y, z), {})}, 0.0)


def ball_scene(
    name: str,
    places: list[tuple[float, float, float]],
    wall: float = WALL_MM,
    color: float = 0.5,
) -> GaussianScene:
    """A grey ball recorded at `places` before a red wall."""
    tissue = [(x, y, wall) for x in np.linspace(-110, 110, 45) for y in np.linspace(-90, 90, 37)]
    rng = np.random.default_rng(0)
    shell = rng.standard_normal((1500, 3))
    shell *= (RADIUS - SKIN) / np.linalg.norm(shell, axis=1, keepdims=True)
    means = torch.tensor(np.concatenate([tissue, shell]), dtype=torch.float32)
    count, inside = len(means), len(shell)
    colors = torch.full((count, 3), color)
    colors[: len(tissue)] = torch.tensor([0.7, 0.3, 0.3])
    canonical = CanonicalGaussians(
        means,
        torch.tensor([[1.0, 0, 0, 0]]).repeat(count, 1),
        torch.tensor([3.5] * len(tissue) + [0.45] * inside).log()[:, None].repeat(1, 3),
        torch.full((count,), 4.0),
        (colors[:, None] - 0.5) / 0.28209479177387814,
        torch.zeros(count, 15, 3),
        counts=(len(tissue), inside),
        extras={LINK_LOGITS: torch.zeros(count, 1)},
    )
    states = tuple(ball_state(name, *place) for place in places)
    names = tuple(f"{k:06d}" for k in range(len(states)))
    recorded = Recorded(names, ("train",) * len(states), states, (CAMERA,) * len(states))
    instruments = (Instrument(name, {}),)
    scene = GaussianScene(
        "kinematic", canonical, Kinematic(instruments), instruments, recorded, torch.tensor([0.0, 0, wall])
    )
    return scene.requires_grad_(False)  # as a scene is that was read


def run_of(scene: GaussianScene, path: Path) -> FakeRun:
    path.mkdir()
    save_scene(scene, path / "scene.safetensors")
    return FakeRun(path, scene)
