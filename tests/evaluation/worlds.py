"""A tiny world with a known answer: a textured wall of tissue and one bar that moves in front of it."""

from __future__ import annotations

from contextlib import AbstractContextManager
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from neeco.capture.images import write_image, write_labels
from neeco.capture.model import Capture, Frame, Instrument, InstrumentState, PointCloud, State
from neeco.methods.static import Static
from neeco.raster import Camera, Gaussians, Rendering, rasterize
from neeco.scene import Recorded

WIDTH, HEIGHT = 48, 40


class Rest(Static):
    """Not what moves the bar: the scene does so itself."""


@dataclass
class TinyScene:
    """What evaluation needs of a scene: tissue 100 to 110 mm away, a two-part bar at its instrument's origin."""

    labelled: bool = True
    has_gaussians = True
    casts_shadow = False
    method: str = "tiny"
    diagnostics: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        random = torch.Generator().manual_seed(3)
        across, down = torch.meshgrid(torch.linspace(-40, 40, 11), torch.linspace(-34, 34, 9), indexing="ij")
        # neighbours differ in depth: on an exact plane a tiny turn of the camera would change who is in front
        depth = 100 + 10 * torch.rand(across.shape, generator=random)
        self.tissue = torch.stack([across, down, depth], -1).reshape(-1, 3)
        self.bar = torch.stack([torch.linspace(-12, 12, 9), torch.zeros(9), torch.linspace(-4, 4, 9)], -1)
        count = len(self.tissue) + len(self.bar)
        self.colors = torch.rand(count, 1, 3, generator=random) * 2 - 1
        self.colors[len(self.tissue) :] += 1.2
        self.instruments = (Instrument("bar"),)
        self.recorded = Recorded()
        self.deformation = Rest(self.instruments)
        self.label_names = (("bar", "shaft"), ("bar", "jaw_left")) if self.labelled else ()

    def at(self, state: State) -> Gaussians:
        pose = state.instruments["bar"].pose.float()
        means = torch.cat([self.tissue, self.bar @ pose[:3, :3].T + pose[:3, 3]])
        scales = torch.cat([torch.full((len(self.tissue), 3), 5.0), torch.full((len(self.bar), 3), 2.0)])
        count = len(means)
        return Gaussians(
            means, torch.tensor([[1.0, 0, 0, 0]]).repeat(count, 1), scales, torch.full((count,), 0.95), self.colors
        )

    def render(self, state: State, camera: Camera, labels: bool = False) -> Rendering:
        return rasterize(self.at(state), camera, channels=self.label_channels() if labels and self.labelled else None)

    @property
    def canonical(self) -> SimpleNamespace:
        rows = torch.arange(self.num_gaussians)
        return SimpleNamespace(of_instruments=rows >= len(self.tissue))

    def motion(self) -> None:
        return None

    def torch_threads(self) -> AbstractContextManager[None]:
        return self.deformation.torch_threads()

    @property
    def num_gaussians(self) -> int:
        return len(self.tissue) + len(self.bar)

    def label_channels(self) -> Tensor:
        channels = torch.zeros(len(self.tissue) + len(self.bar), len(self.label_names))
        if self.labelled:
            channels[len(self.tissue) : len(self.tissue) + 5, 0] = 1
            channels[len(self.tissue) + 5 :, 1] = 1
        return channels


@dataclass
class TinyRun:
    """What evaluation needs of a run."""

    path: Path
    scene: TinyScene
    recorded: Capture
    doubts: tuple[str, ...] = ()

    def capture(self) -> Capture:
        return self.recorded


def translation(x: float = 0.0, y: float = 0.0, z: float = 0.0, yaw: float = 0.0) -> Tensor:
    """[4, 4] float64: a turn about z by `yaw` rad, then a shift in mm."""
    pose = torch.eye(4, dtype=torch.float64)
    cosine, sine = float(np.cos(yaw)), float(np.sin(yaw))
    pose[:2, :2] = torch.tensor([[cosine, -sine], [sine, cosine]], dtype=torch.float64)
    pose[:3, 3] = torch.tensor([x, y, z], dtype=torch.float64)
    return pose


def camera_at(x: float = 0.0, y: float = 0.0, z: float = 0.0, yaw: float = 0.0) -> Camera:
    """A camera looking along +z."""
    return Camera(translation(x, y, z, yaw), 50.0, 50.0, WIDTH / 2, HEIGHT / 2, WIDTH, HEIGHT)


def state_at(x: float, y: float, z: float = 60.0, yaw: float = 0.0) -> State:
    """The bar somewhere in front of the tissue."""
    return State({"bar": InstrumentState(translation(x, y, z, yaw))})


def make_capture(
    root: Path, scene: TinyScene, splits: tuple[str, ...], *, truth: bool = True, depth: float = 60.0
) -> Capture:
    """One recorded image per entry of `splits`, drawn by the scene itself, so every score has a known best; the bar
    `depth` mm from the world's origin."""
    frames = []
    for index, split in enumerate(splits):
        state, camera = state_at(3.0 * index - 5, 2.0 * index - 3, depth), camera_at(0.3 * index)
        rendering = rasterize(scene.at(state), camera, channels=TinyScene().label_channels())
        path = root / "images" / f"{index:03d}.png"
        write_image(path, rendering.color)
        if truth:
            assert rendering.channels is not None
            columns = rendering.channels.argmax(-1)
            parts = torch.where(rendering.channels.sum(-1) > 0.65, torch.tensor([1, 3])[columns], 0)
            write_labels(root / "truth" / "masks" / f"{index:03d}.png", parts.to(torch.uint8))
        frames.append(Frame(path, camera, state, split))
    points = PointCloud(scene.tissue.numpy().astype(np.float32), np.full((len(scene.tissue), 3), 0.5, np.float32))
    return Capture(root, tuple(frames), scene.instruments, points)


def moved(frame: Frame, instrument: Tensor, camera: Tensor) -> Frame:
    """The same recorded image with wrong poses: both transforms are applied in the moving body's own frame."""
    given = frame.state.instruments["bar"]
    state = replace(frame.state, instruments={"bar": replace(given, pose=given.pose @ instrument)})
    return replace(
        frame, state=state, camera=replace(frame.camera, world_from_camera=frame.camera.world_from_camera @ camera)
    )
