"""Makes `benchmarks/` importable, and reads what a rendered capture's truth says of its frames."""

from __future__ import annotations

import importlib
import json
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from PIL import Image

BENCHMARKS = Path(__file__).resolve().parents[1] / "benchmarks"


@pytest.fixture(scope="module")
def benchmarks() -> Iterator[ModuleType]:
    """Makes `benchmarks/` importable; gives the script that renders captures."""
    sys.path.insert(0, str(BENCHMARKS))
    try:
        yield importlib.import_module("rendered_captures")
    finally:
        sys.path.remove(str(BENCHMARKS))


def truth_of(capture: Path) -> dict[str, Any]:
    """truth/transforms.json."""
    return json.loads((capture / "truth" / "transforms.json").read_text())


def frames_with_depth(capture: Path) -> list[dict[str, Any]]:
    return [frame for frame in truth_of(capture)["frames"] if "depth_file_path" in frame]


def labels(capture: Path, frame: dict[str, Any]) -> np.ndarray:
    """Part ids [H, W]."""
    return np.array(Image.open(capture / "truth" / frame["part_mask_path"]))


def sensor_from_camera(frame: dict[str, Any]) -> np.ndarray:
    """[4, 4], OpenCV axes."""
    world_from_camera = np.array(frame["transform_matrix"]) @ np.diag([1, -1, -1, 1])
    return np.linalg.inv(np.array(frame["instruments"][0]["pose"])) @ world_from_camera


def seen_points(capture: Path, frame: dict[str, Any]) -> tuple[np.ndarray, np.ndarray]:
    """Surface points [M, 3] in the sensor's frame from the stored depth, and their part ids [M]."""
    lens = truth_of(capture)
    depth = np.array(Image.open(capture / "truth" / frame["depth_file_path"])).astype(float) * 0.05
    v, u = np.mgrid[0 : lens["h"] : 2, 0 : lens["w"] : 2] + 0.5
    rays = np.stack([(u - lens["cx"]) / lens["fl_x"], (v - lens["cy"]) / lens["fl_y"], np.ones_like(u)], -1)
    transform = sensor_from_camera(frame)
    points = (rays * depth[..., None]) @ transform[:3, :3].T + transform[:3, 3]
    return points.reshape(-1, 3), labels(capture, frame)[::2, ::2].ravel()
