"""A grasper with a spotted shaft and two jaws before a wall, small enough to be tracked in a second."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from neeco.capture.images import write_image
from neeco.capture.model import Capture, Frame, Instrument, InstrumentState, PointCloud, State
from neeco.geometry.camera import Camera
from neeco.methods.kinematic.articulation import LINK_LOGITS
from neeco.scene import CanonicalGaussians, GaussianScene, Recorded
from neeco.scene.method_registry import make_deformation, method_settings
from neeco.training.config import config_to_dict, method_defaults

CAMERA = Camera(torch.eye(4, dtype=torch.float64), fx=90.0, fy=90.0, cx=48.0, cy=32.0, width=96, height=64)
GRASPER = Instrument("grasper", {"jaw_angle": (0.0, 1.2)})
WALL_MM, SURE = 100.0, 30.0
FRAMES, RATE = 8, 25.0


def grasper_state(
    x: float = 0.0, y: float = 0.0, z: float = 70.0, turn: float = 0.0, roll: float = 0.0, jaw: float = 0.5
) -> State:
    """The hinge at (x, y, z) mm; the shaft comes from the image's left, `turn` rad about the line of sight and `roll`
    about itself; its jaws open by `jaw` rad."""
    pose = np.eye(4)
    across = Rotation.from_rotvec([0, math.pi / 2, 0])  # the shaft's z to the image's x
    pose[:3, :3] = (Rotation.from_rotvec([0, 0, turn]) * across * Rotation.from_rotvec([0, 0, roll])).as_matrix()
    pose[:3, 3] = x, y, z
    return State({"grasper": InstrumentState(torch.from_numpy(pose), {"jaw_angle": jaw})})


def moving(k: float) -> State:
    """The state at frame k of the footage."""
    state = grasper_state(-8 + 2.0 * k, 3 * math.sin(k / 3), 70 + k / 2, 0.04 * k, 0.3 - 0.08 * k, 0.55 + 0.04 * k)
    return replace(state, time=k / RATE)


def make_scene() -> GaussianScene:
    """A wall, a shaft whose colour changes along and around it, and jaws that the hinge turns apart."""
    rng = np.random.default_rng(3)
    wall = [(x, y, WALL_MM) for x in np.linspace(-90, 90, 30) for y in np.linspace(-60, 60, 20)]
    around = np.arange(8) * math.pi / 4
    shaft = [(3 * math.cos(a), 3 * math.sin(a), z) for z in np.linspace(-40, -1, 24) for a in around]
    jaws = [[(x, side, z) for z in np.linspace(1, 14, 14) for x in (-1.0, 1.0)] for side in (1.0, -1.0)]
    means = torch.tensor([*wall, *shaft, *jaws[0], *jaws[1]], dtype=torch.float32)
    spots = [(0.2 + 0.6 * (k % 8 < 3), 0.3 + 0.4 * (k // 24 % 2), 0.8 - 0.1 * (k % 8)) for k in range(len(shaft))]
    colors = [*(np.array([0.6, 0.25, 0.2]) + rng.uniform(-0.1, 0.1, (len(wall), 3))), *spots]
    colors += [(0.9, 0.9, 0.6)] * len(jaws[0]) + [(0.5, 0.8, 0.9)] * len(jaws[1])
    size = torch.tensor([3.5] * len(wall) + [1.0] * len(shaft) + [0.8] * 2 * len(jaws[0]))
    logits = torch.zeros(len(means), 3)
    for link, rows in enumerate((len(shaft), len(jaws[0]), len(jaws[1]))):
        start = len(wall) + (0, len(shaft), len(shaft) + len(jaws[0]))[link]
        logits[start : start + rows, link] = SURE
    canonical = CanonicalGaussians(
        means=means,
        quats=torch.tensor([[1.0, 0, 0, 0]]).repeat(len(means), 1),
        log_scales=size.log()[:, None].repeat(1, 3),
        opacity_logits=torch.full((len(means),), 4.0),
        sh_dc=(torch.tensor(np.array(colors), dtype=torch.float32)[:, None] - 0.5) / 0.28209479177387814,
        sh_rest=torch.zeros(len(means), 15, 3),
        counts=(len(wall), len(means) - len(wall)),
        extras={LINK_LOGITS: logits},
    )
    states = tuple(moving(k - 8.5) for k in range(24))  # at the footage's pace, between its frames
    names = tuple(f"{k:06d}" for k in range(len(states)))
    recorded = Recorded(names, ("train",) * len(states), states, (CAMERA,) * len(states))
    deformation = make_deformation("kinematic", (GRASPER,), method_settings("kinematic", {}))
    scene = GaussianScene("kinematic", canonical, deformation, (GRASPER,), recorded, torch.tensor([0.0, 0.0, WALL_MM]))
    articulation = deformation.articulations[0]
    articulation.extent.copy_(torch.tensor([-40.0, 14.0]))
    articulation.radius.fill_(3.0)
    return scene.requires_grad_(False)


@dataclass(frozen=True)
class RecordedRun:
    """As much of a run as tracking uses."""

    path: Path
    scene: GaussianScene
    recording: Capture
    config: dict[str, Any] = field(default_factory=lambda: config_to_dict(method_defaults("kinematic")))

    def capture(self) -> Capture:
        return self.recording


def record(scene: GaussianScene, root: Path, states: list[State], split: str) -> Capture:
    """Images of the scene in `states`, as a capture that says them."""
    frames = []
    for k, state in enumerate(states):
        path = root / "images" / f"{k:06d}.png"
        write_image(path, scene.render(state, CAMERA).color.clamp(0, 1))
        frames.append(Frame(path, CAMERA, state, split))
    wall = scene.canonical.means[: scene.canonical.counts[0]].numpy()
    points = PointCloud(wall, np.full_like(wall, 0.5))
    return Capture(root, tuple(frames), (GRASPER,), points)


def make_run(root: Path) -> RecordedRun:
    """The scene, with eight of its training frames."""
    scene = make_scene()
    root.mkdir(parents=True, exist_ok=True)
    (root / "scene.safetensors").write_bytes(b"the scene's bits")
    chosen = list(range(0, len(scene.recorded.states), 3))
    recording = record(scene, root / "recording", [scene.recorded.states[k] for k in chosen], "train")
    frames = tuple(
        replace(frame, image_path=frame.image_path.rename(frame.image_path.with_name(f"{k:06d}-train.png")))
        for k, frame in zip(chosen, recording.frames, strict=True)
    )
    return RecordedRun(root, scene, replace(recording, frames=frames))


def withheld(capture: Capture) -> Capture:
    """The same footage, its states withheld but for the first."""
    first, *others = capture.frames
    bare = [replace(frame, state=State({}, frame.state.time)) for frame in others]
    return replace(capture, frames=(first, *bare))
