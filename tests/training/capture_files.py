"""A capture small enough to train on in a second."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from PIL import Image
from scipy.spatial.transform import Rotation

FRAMES = 8


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
