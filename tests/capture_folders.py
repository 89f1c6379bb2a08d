"""A tiny capture, made anew for every test: 8 frames of 32x24 pixels around a blob of points."""

from __future__ import annotations

import copy
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

FRAMES = 8


class Folder:
    """A capture on disk that tests damage."""

    def __init__(self, root: Path) -> None:
        self.root = root

    @property
    def document(self) -> dict[str, Any]:
        return json.loads((self.root / "transforms.json").read_text())

    def write(self, document: Any) -> None:
        (self.root / "transforms.json").write_text(json.dumps(document))

    def edit(self, change: Callable[[dict[str, Any]], object]) -> None:
        document = self.document
        change(document)
        self.write(document)

    def edit_poses(self, change: Callable[[np.ndarray], np.ndarray]) -> None:
        """Replace every instrument pose [4, 4]."""
        for_all = self.document
        for frame in for_all["frames"]:
            for state in frame["instruments"]:
                state["pose"] = change(np.array(state["pose"])).tolist()
        self.write(for_all)

    def edit_cameras(self, change: Callable[[np.ndarray], np.ndarray]) -> None:
        """Replace every camera's transform_matrix [4, 4]."""
        for_all = self.document
        for frame in for_all["frames"]:
            frame["transform_matrix"] = change(np.array(frame["transform_matrix"])).tolist()
        self.write(for_all)


def opengl_camera(angle: float, distance: float = 100.0) -> np.ndarray:
    """Camera-to-world, OpenGL axes: on a circle about the point (30, -20, 50), looking at it."""
    back = np.array([np.sin(angle), 0.3, np.cos(angle)])
    back /= np.linalg.norm(back)
    right = np.cross([0.0, 1.0, 0.0], back)
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(back, right), back], axis=1)
    pose[:3, 3] = np.array([30.0, -20.0, 50.0]) + distance * back
    return pose


def instrument_pose(index: int) -> np.ndarray:
    """Turning and moving a little near the middle of the scene."""
    pose = np.eye(4)
    turn = [0.8 * np.sin(index), 0.6 * np.cos(2 * index), 0.25 * index]
    pose[:3, :3] = Rotation.from_rotvec(turn).as_matrix()
    pose[:3, 3] = [30.0 + 1.5 * index - 5, -20.0 - index, 52.0 + index]
    return pose


def write_folder(root: Path) -> Folder:
    generator = np.random.default_rng(7)
    (root / "images").mkdir(parents=True)
    points = np.array([30.0, -20.0, 50.0]) + generator.normal(0, 6, (150, 3))
    header = ["ply", "format ascii 1.0", "element vertex 150", *(f"property float {axis}" for axis in "xyz")]
    header += [*(f"property uchar {name}" for name in ("red", "green", "blue")), "end_header"]
    rows = [f"{x:.4f} {y:.4f} {z:.4f} 200 100 50" for x, y, z in points]
    (root / "sparse.ply").write_text("\n".join(header + rows) + "\n")
    frames = []
    for index in range(FRAMES):
        name = f"images/{index:06d}.png"
        Image.fromarray(generator.integers(0, 255, (24, 32, 3), dtype=np.uint8)).save(root / name)
        state = {"name": "grasper", "pose": instrument_pose(index).tolist(), "joints": {"jaw_angle": 0.1 * index}}
        frame = {"file_path": name, "transform_matrix": opengl_camera(0.1 * index - 0.4).tolist(), "time": 0.04 * index}
        frames.append({**frame, "split": "test" if index == 4 else "train", "instruments": [state]})
    camera = {"camera_model": "PINHOLE", "fl_x": 40.0, "fl_y": 41.0, "cx": 16.5, "cy": 12.0, "w": 32, "h": 24}
    limits = [{"name": "grasper", "joints": {"jaw_angle": {"limits": [0, 1.5]}}}]
    folder = Folder(root)
    folder.write({**camera, "ply_file_path": "sparse.ply", "instruments": limits, "frames": frames})
    return folder


@pytest.fixture
def folder(tmp_path: Path) -> Folder:
    return write_folder(tmp_path / "capture")


@pytest.fixture(scope="session")
def pristine(tmp_path_factory: pytest.TempPathFactory) -> tuple[Folder, dict[str, Any]]:
    """A capture shared by tests that restore its JSON, and that JSON."""
    folder = write_folder(tmp_path_factory.mktemp("pristine") / "capture")
    return folder, copy.deepcopy(folder.document)
