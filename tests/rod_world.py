"""A scene small enough to draw in milliseconds: a tissue wall, and a rod with a jaw that moves before it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from neeco.capture.model import Instrument, InstrumentState, State
from neeco.geometry.camera import Camera
from neeco.scene import CanonicalGaussians, GaussianScene, Recorded
from neeco.scene.deformation import UNPERTURBED, Deformation, Deltas, Perturbation, Posed

WALL_MM = 100.0
CAMERA = Camera(torch.eye(4, dtype=torch.float64), fx=60.0, fy=60.0, cx=32.0, cy=24.0, width=64, height=48)


class Rod(Deformation):
    """The body after the tissue follows the pose; the last third of its rows turns about x by the jaw angle."""

    label_names = (("rod", "shaft"), ("rod", "jaw"))

    def __init__(self, jaw_rows: int, instrument: str = "rod") -> None:
        super().__init__(())
        self.jaw_rows, self.instrument = jaw_rows, instrument

    def pose(self, canonical: CanonicalGaussians, state: State, perturbation: Perturbation = UNPERTURBED) -> Posed:
        given = state.instruments[self.instrument]
        means = canonical.means.clone()
        jaw = means[-self.jaw_rows :] @ torch.from_numpy(self._jaw(given)).float().T
        local = torch.cat([means[canonical.counts[0] : -self.jaw_rows], jaw])
        pose = given.pose.float()
        means[canonical.counts[0] :] = local @ pose[:3, :3].T + pose[:3, 3]
        return Posed(means, canonical.quats, canonical.log_scales.exp())

    def _jaw(self, given: InstrumentState) -> np.ndarray:
        return Rotation.from_rotvec([given.joints["jaw_angle"], 0, 0]).as_matrix()

    def label_channels(self, canonical: CanonicalGaussians) -> Tensor:
        channels = torch.zeros(len(canonical), 2)
        channels[canonical.counts[0] :, 0] = 1
        channels[-self.jaw_rows :] = torch.tensor([0.0, 1.0])
        return channels

    def deltas(self, canonical: CanonicalGaussians, state: State) -> Deltas:
        deltas = super().deltas(canonical, state)
        # what a network leaves on points that do not move
        deltas.means[: canonical.counts[0]] += 1e-3 * torch.linspace(0.1, 1, canonical.counts[0])[:, None]
        return deltas

    def keypoints(self, state: State) -> dict[str, dict[str, Tensor]]:
        given = state.instruments[self.instrument]
        pose = given.pose.float()
        local = {
            "shaft_far": torch.tensor([0.0, -30.0, 0.0]),
            "shaft_near": torch.tensor([0.0, -4.0, 0.0]),
            "hinge": torch.zeros(3),
            "tip_left": torch.from_numpy(self._jaw(given) @ [-1.0, 10.0, 0.0]).float(),
            "tip_right": torch.from_numpy(self._jaw(given) @ [1.0, 10.0, 0.0]).float(),
        }
        return {self.instrument: {name: pose[:3, :3] @ point + pose[:3, 3] for name, point in local.items()}}


def rod_state(x: float = 0.0, y: float = 0.0, z: float = 70.0, roll: float = 0.0, jaw: float = 0.2) -> State:
    """The rod's hinge at (x, y, z) mm, turned about the viewing axis, its shaft pointing up in the image."""
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_rotvec([0, 0, roll]).as_matrix()
    pose[:3, 3] = x, y, z
    return State({"rod": InstrumentState(torch.from_numpy(pose), {"jaw_angle": jaw})}, time=0.0)


def make_scene() -> GaussianScene:
    """640 tissue Gaussians in a wall at 100 mm; 60 of the shaft and 30 of the jaw."""
    wall = [(x, y, WALL_MM) for x in np.linspace(-80, 80, 32) for y in np.linspace(-60, 60, 20)]
    shaft = [(0.0, y, 0.0) for y in np.linspace(-40, 0, 60)]
    jaw = [(0.0, y, 0.0) for y in np.linspace(0.5, 10, 30)]
    means = torch.tensor([*wall, *shaft, *jaw], dtype=torch.float32)
    count = len(means)
    size = torch.tensor([3.5] * len(wall) + [2.0] * len(shaft) + [1.5] * len(jaw))
    color = torch.tensor([(0.7, 0.3, 0.3)] * len(wall) + [(0.8, 0.8, 0.9)] * len(shaft) + [(0.4, 0.7, 0.9)] * len(jaw))
    canonical = CanonicalGaussians(
        means=means,
        quats=torch.tensor([[1.0, 0, 0, 0]]).repeat(count, 1),
        log_scales=size.log()[:, None].repeat(1, 3),
        opacity_logits=torch.full((count,), 4.0),
        sh_dc=(color[:, None] - 0.5) / 0.28209479177387814,
        sh_rest=torch.zeros(count, 15, 3),
        counts=(len(wall), len(shaft) + len(jaw)),
    )
    rng = np.random.default_rng(7)
    states = tuple(
        rod_state(*rng.uniform([-12, -4, 66], [12, 10, 74]), rng.uniform(-0.5, 0.5), jaw)
        for jaw in np.linspace(0, 0.8, 12)
    )
    names = tuple(f"{k:06d}" for k in range(len(states)))
    recorded = Recorded(names, ("train",) * len(states), states, (CAMERA,) * len(states))
    instruments = (Instrument("rod", {"jaw_angle": (0.0, 0.9)}),)
    return GaussianScene("rod", canonical, Rod(len(jaw)), instruments, recorded, torch.tensor([0.0, 0, WALL_MM]))


@dataclass(frozen=True)
class FakeRun:
    """As much of a run as synthesis uses."""

    path: Path
    scene: GaussianScene

    def gaussians(self, asked_by: str) -> FakeRun:
        return self

    def require_trusted(self, verb: str) -> None:
        """Its labels are exact."""


@pytest.fixture(scope="session")
def scene() -> GaussianScene:
    return make_scene()


@pytest.fixture(scope="session")
def run(scene: GaussianScene, tmp_path_factory: pytest.TempPathFactory) -> FakeRun:
    path = tmp_path_factory.mktemp("run")
    (path / "scene.safetensors").write_bytes(b"the scene's bits")
    return FakeRun(path, scene)


@pytest.fixture(scope="session")
def state() -> Callable[..., State]:
    return rod_state


@pytest.fixture(scope="session")
def camera() -> Camera:
    return CAMERA
