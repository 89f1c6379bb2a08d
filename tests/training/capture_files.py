"""Captures small enough to train on in a second: noise, and a drawn grasper over tissue."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from scipy.spatial.transform import Rotation
from torch import Tensor

from neeco.capture.images import write_image
from neeco.capture.model import Capture, Frame, Instrument, InstrumentState, PointCloud, State
from neeco.capture.writer import write_capture as write_folder
from neeco.geometry.rotations import rigid_from_vector, rotate_about
from neeco.raster import Camera, Gaussians, rasterize
from neeco.training.config import TrainConfig
from neeco.training.train import ProgressRow, train

FRAMES = 8
PIVOT_MM, WRIST_MM = 6.0, -3.0  # along the grasper's shaft, which is z of its frame


def write_capture(root: Path, *, instruments: bool = True) -> Path:
    """8 frames of 32x24 noise around a blob of points; the instrument's poses and jaw vary."""
    rng = np.random.default_rng(7)
    (root / "images").mkdir(parents=True)
    header = ["ply", "format ascii 1.0", "element vertex 150", *(f"property float {axis}" for axis in "xyz")]
    header += [*(f"property uchar {name}" for name in ("red", "green", "blue")), "end_header"]
    rows = [f"{x:.4f} {y:.4f} {z:.4f} 200 100 50" for x, y, z in rng.normal(0, 6, (150, 3))]
    (root / "sparse.ply").write_text("\n".join(header + rows) + "\n")
    frames = []
    for k in range(FRAMES):
        Image.fromarray(rng.integers(0, 255, (24, 32, 3), dtype=np.uint8)).save(root / f"images/{k:06d}.png")
        camera, pose = np.eye(4), np.eye(4)
        camera[:3, :3] = Rotation.from_rotvec([0, 0.1 * k - 0.4, 0]).as_matrix()
        camera[:3, 3] = camera[:3, 2] * 100
        pose[:3, :3] = Rotation.from_rotvec([0.8 * np.sin(k), 0.6 * np.cos(2 * k), 0.25 * k]).as_matrix()
        pose[:3, 3] = [1.5 * k - 5, -k, 2 + k]
        state = {"name": "grasper", "pose": pose.tolist(), "joints": {"jaw_angle": 0.1 * k}}
        frame = {"file_path": f"images/{k:06d}.png", "transform_matrix": camera.tolist(), "time": 0.04 * k}
        frames.append({**frame, "split": "train", "instruments": [state]})
    document = {"camera_model": "PINHOLE", "fl_x": 40.0, "fl_y": 41.0, "cx": 16.5, "cy": 12.0, "w": 32, "h": 24}
    document |= {"ply_file_path": "sparse.ply", "frames": frames}
    if not instruments:
        document["frames"] = [{key: frame[key] for key in frame if key != "instruments"} for frame in frames]
        (root / "transforms.json").write_text(json.dumps(document))
        return root
    document["instruments"] = [{"name": "grasper", "joints": {"jaw_angle": {"limits": [0, 1.5]}}}]
    (root / "transforms.json").write_text(json.dumps(document))
    return root


def train_interrupted(capture: Path, folder: Path, config: TrainConfig, stop: int) -> tuple[Path, Path]:
    """An uninterrupted run, and one that stopped after `stop` iterations and was resumed; both have the same scene."""

    def interrupt(row: ProgressRow) -> None:
        if row.iteration == stop and not row.note:
            raise KeyboardInterrupt

    whole = train(capture, folder / "whole", config)
    with pytest.raises(KeyboardInterrupt):
        train(capture, folder / "cut", config, progress=interrupt)
    assert not (folder / "cut" / "scene.safetensors").exists()
    resumed = train(capture, folder / "cut", config, resume=True)
    assert (resumed / "scene.safetensors").read_bytes() == (whole / "scene.safetensors").read_bytes()
    return whole, resumed


def write_grasper(
    root: Path, *, frames: int = 24, sizes: tuple[tuple[int, int], ...] = ((80, 64),), wristed: bool = False
) -> Path:
    """A two-jawed grasper that moves and opens, and bends its wrist where it has one, before a red wall, recorded in
    images of `sizes` in turn."""
    rng = np.random.default_rng(5)
    wall = torch.from_numpy(rng.uniform([-75, -60, 98], [75, 60, 102], (900, 3))).float()
    wall_colors = torch.from_numpy(rng.uniform(0.3, 0.7, (900, 3)) * (1.2, 0.6, 0.6)).float()
    (root / "images").mkdir(parents=True)
    taken = []
    for k in range(frames):
        width, height = sizes[k % len(sizes)]
        camera = Camera(torch.eye(4, dtype=torch.float64), width, width, width / 2, height / 2, width, height)
        opening = 0.5 + 0.5 * math.sin(1.7 * k)
        tilt, pan, roll = rng.uniform(-0.5, 0.5), rng.uniform(-0.5, 0.5), rng.uniform(-1.2, 1.2)
        turn = rigid_from_vector(torch.tensor([0.9 + tilt, pan, roll, 0, 0, 0], dtype=torch.float64))
        pose = turn.clone()
        pose[:3, 3] = torch.tensor([rng.uniform(-14, 14), rng.uniform(-10, 10), rng.uniform(64, 78)])
        readings = {"jaw_angle": opening} | ({"wrist_pitch": rng.uniform(-0.9, 0.9)} if wristed else {})
        body, colors = grasper_body(**readings)
        means = torch.cat([wall, body @ pose[:3, :3].float().T + pose[:3, 3].float()])
        count = len(means)
        gaussians = Gaussians(
            means,
            torch.tensor([[1.0, 0, 0, 0]]).repeat(count, 1),
            torch.cat([torch.full((len(wall), 3), 3.5), torch.full((len(body), 3), 1.3)]),
            torch.full((count,), 0.95),
            ((torch.cat([wall_colors, colors]) - 0.5) / 0.2820948)[:, None],
        )
        path = root / "images" / f"{k:06d}.png"
        write_image(path, rasterize(gaussians, camera).color)
        state = State({"grasper": InstrumentState(pose, readings)}, 0.04 * k)
        taken.append(Frame(path, camera, state, "train" if k % 6 else "test"))
    points = PointCloud(wall.numpy(), wall_colors.numpy().clip(0, 1))
    instruments = (Instrument("grasper", {"jaw_angle": (0.0, 1.5)} | ({"wrist_pitch": None} if wristed else {})),)
    write_folder(Capture(root, tuple(taken), instruments, points), root)
    return root


def grasper_body(jaw_angle: float, wrist_pitch: float = 0.0) -> tuple[Tensor, Tensor]:
    """Points [M, 3] mm and colours [M, 3]: a shaft along z, its wrist brighter, which pitches about y, and two jaws."""
    around = torch.arange(8) * (math.pi / 4)
    along = torch.arange(-30.0, PIVOT_MM, 1.5)
    shaft = torch.stack([around.cos().repeat(24) * 2, around.sin().repeat(24) * 2, along.repeat_interleave(8)], -1)
    blade = torch.stack([torch.zeros(15), torch.zeros(15), torch.linspace(PIVOT_MM, 20, 15)], -1)
    pivot, axis = torch.tensor([0.0, 0.0, PIVOT_MM]), torch.tensor([1.0, 0.0, 0.0])
    jaws = [rotate_about(blade, axis, pivot, torch.full((15,), side * jaw_angle / 2)) for side in (1, -1)]
    bright = (shaft[:, 2:] > WRIST_MM).float().expand(-1, 3)
    colors = torch.cat([0.15 + 0.7 * bright, torch.full((30, 3), 0.85)])
    points = torch.cat([shaft, *jaws])
    turn = torch.where(points[:, 2] > WRIST_MM, wrist_pitch, 0.0)
    return rotate_about(points, torch.tensor([0.0, 1.0, 0.0]), torch.tensor([0.0, 0.0, WRIST_MM]), turn), colors
