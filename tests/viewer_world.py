"""A grasper before a wall, and runs of it: folders whose recorded images are what the scene itself draws."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from scene_worlds import pose_of

from neeco.capture.images import write_image, write_labels
from neeco.capture.model import Capture, Frame, Instrument, InstrumentState, PointCloud, State
from neeco.capture.readers import read_capture
from neeco.capture.writer import fingerprint, write_capture
from neeco.geometry.camera import Camera
from neeco.labels.drawing import draw
from neeco.methods.kinematic.articulation import LINK_LOGITS
from neeco.scene import CanonicalGaussians, GaussianScene, Recorded
from neeco.scene.drawable import DrawableScene
from neeco.scene.io import save_scene
from neeco.scene.method_registry import make_deformation, method_settings
from neeco.training.config import TrainConfig
from neeco.training.run import write_config

WIDTH, HEIGHT, FRAMES = 64, 48, 9
SURE = 12.0  # a part logit that leaves no doubt
LIMITS = (0.0, 1.2)
SH_DC = 0.28209479177387814


def camera(turn: float = 0.0) -> Camera:
    """At the world's origin, turned to the side."""
    pose = pose_of(0.0, turn, 0.0, 0.0, 0.0, 0.0)
    return Camera(pose, fx=60.0, fy=60.0, cx=WIDTH / 2, cy=HEIGHT / 2, width=WIDTH, height=HEIGHT)


def grasper_scene(name: str = "grasper", joint: str = "jaw_angle", frame_name: str = "{:06d}") -> GaussianScene:
    """A shaft along z of its frame with two jaws beyond z = 0, before a red wall 100 mm away; the camera turns."""
    wall = [(x, y, 100.0) for x in np.linspace(-90, 90, 30) for y in np.linspace(-70, 70, 24)]
    shaft = [(math.cos(a) * 2, math.sin(a) * 2, z) for z in np.linspace(-40, 0, 30) for a in (0.0, 2.1, 4.2)]
    jaws = [(side * 1.5, 0.0, z) for side in (-1, 1) for z in np.linspace(1, 14, 20)]
    means = torch.tensor([*wall, *shaft, *jaws], dtype=torch.float32)
    count = len(means)
    sizes = torch.tensor([4.0] * len(wall) + [1.6] * len(shaft) + [1.2] * len(jaws))
    red, grey, green = (0.7, 0.3, 0.3), (0.8, 0.8, 0.9), (0.3, 0.7, 0.4)
    colors = torch.tensor([red] * len(wall) + [grey] * len(shaft) + [green] * len(jaws))
    logits = torch.zeros(count, 3)
    logits[: -len(jaws), 0] = SURE
    logits[-len(jaws) : -len(jaws) // 2, 1] = SURE
    logits[-len(jaws) // 2 :, 2] = SURE
    canonical = CanonicalGaussians(
        means=means,
        quats=torch.tensor([[1.0, 0, 0, 0]]).repeat(count, 1),
        log_scales=sizes.log()[:, None].repeat(1, 3),
        opacity_logits=torch.full((count,), 4.0),
        sh_dc=(colors[:, None] - 0.5) / SH_DC,
        sh_rest=torch.zeros(count, 15, 3),
        counts=(len(wall), len(shaft) + len(jaws)),
        extras={LINK_LOGITS: logits},
    )
    instruments = (Instrument(name, {joint: LIMITS}),)
    deformation = make_deformation("kinematic", instruments, method_settings("kinematic", {}))
    hinges = deformation.articulations[0]
    hinges.extent.copy_(torch.tensor([-40.0, 14.0]))
    hinges.wrist_start.fill_(-3.0)
    states = tuple(
        State({name: InstrumentState(pose_of(1.2, 0.3, 0.05 * k, k - 4.0, 3.0 - k, 70.0), {joint: 0.1 * k})}, 0.1 * k)
        for k in range(FRAMES)
    )
    recorded = Recorded(
        tuple(frame_name.format(k) for k in range(FRAMES)),
        tuple("test" if k % 4 == 3 else "train" for k in range(FRAMES)),
        states,
        tuple(camera(0.01 * k) for k in range(FRAMES)),
    )
    scene = GaussianScene("kinematic", canonical, deformation, instruments, recorded, torch.tensor([0.0, 0.0, 100.0]))
    return scene.requires_grad_(False)


def write_recorded_images(scene: DrawableScene, root: Path, masks: bool = True) -> Path:
    """The capture whose recorded images the scene draws, with true masks where it has labels. Times are the frames'."""
    frames = []
    for name, split, state, taken_by in zip(
        scene.recorded.names, scene.recorded.splits, scene.recorded.states, scene.recorded.cameras, strict=True
    ):
        path = root / "made" / f"{name}.png"
        drawing = draw(scene, state, taken_by)
        write_image(path, drawing.image)
        if masks and drawing.parts is not None:
            write_labels(root / "truth" / "masks" / f"{name}.png", (drawing.parts > 0).to(torch.uint8))
        frames.append(Frame(path, taken_by, state, split))
    rng = np.random.default_rng(1)
    points = PointCloud(rng.uniform([-40, -30, 98], [40, 30, 102], (60, 3)).astype(np.float32), np.full((60, 3), 0.5))
    write_capture(Capture(root, tuple(frames), scene.instruments, points), root)
    return root


def write_run(scene: DrawableScene, path: Path, capture: Path, finished: bool = True) -> Path:
    """A run folder of `scene`; `finished`: with the scene in it."""
    path.mkdir(parents=True, exist_ok=True)
    digest = fingerprint(read_capture(capture)) if (capture / "transforms.json").is_file() else "0" * 64
    write_config(path, capture, TrainConfig(method=scene.method), digest)
    if finished:
        trained = [k for k, split in enumerate(scene.recorded.splits) if split == "train"]
        kept = scene.recorded
        scene.recorded = Recorded(
            *(tuple(values[k] for k in trained) for values in (kept.names, kept.splits, kept.states, kept.cameras))
        )
        try:
            save_scene(scene, path / "scene.safetensors")
        finally:
            scene.recorded = kept
    return path


def brighter(scene: GaussianScene) -> GaussianScene:
    """The same, after more training."""
    other = grasper_scene(scene.instruments[0].name)
    other.canonical = replace(other.canonical, sh_dc=other.canonical.sh_dc + 0.5)
    return other
