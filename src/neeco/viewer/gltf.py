"""`neeco export --format glb`: a scene that moves, as binary glTF 2.0 with the extension KHR_gaussian_splatting.

One node per part of each link, with which its Gaussians and their harmonics turn; the poses and joints of a sequence of
states are animation channels (`neeco.viewer.moving`). Lengths are in metres, as glTF has them, or in another unit; the
root turns the capture's world (right, down, front) by 180 degrees about z to glTF's axes.
"""

from __future__ import annotations

import json
import math
import struct
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch

from neeco.base.files import write_atomically
from neeco.capture.model import Camera
from neeco.evaluation.image_metrics import to_uint8
from neeco.geometry.rotations import matrix_to_quat
from neeco.raster.reference import SH_C0
from neeco.viewer.moving import MovingScene
from neeco.viewer.splats import Splats

EXTENSION = "KHR_gaussian_splatting"
Unit = Literal["m", "cm", "mm"]
UNITS: Mapping[Unit, float] = {"m": 1e-3, "cm": 0.1, "mm": 1.0}  # of the file, per mm
MAGIC = b"glTF"
COMPONENTS = {"float32": 5126, "uint8": 5121, "int16": 5122}
TYPES = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}
TURN = np.array([0.0, 0.0, 1.0, 0.0])  # xyzw: 180 degrees about z, from the capture's axes to glTF's
CAMERA_TURN = torch.diag(torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64))  # glTF's cameras look along -z


@dataclass
class _Document:
    """JSON and binary chunk while they are put together."""

    per_mm: float  # units of the file
    content: dict[str, Any] = field(default_factory=lambda: {"accessors": [], "bufferViews": [], "meshes": []})
    nodes: list[dict[str, Any]] = field(default_factory=list)
    binary: bytearray = field(default_factory=bytearray)

    def add(self, values: np.ndarray, *, bounds: bool = False) -> int:
        """Return the number of an accessor of values [M, K] or [M], float32 or normalised integers."""
        values = np.ascontiguousarray(values)
        views, accessors = self.content["bufferViews"], self.content["accessors"]
        views.append({"buffer": 0, "byteOffset": len(self.binary), "byteLength": values.nbytes})
        self.binary += values.tobytes() + bytes(-values.nbytes % 4)
        accessor = {
            "bufferView": len(views) - 1,
            "componentType": COMPONENTS[str(values.dtype)],
            "count": len(values),
            "type": TYPES[1 if values.ndim == 1 else values.shape[1]],
        }
        if values.dtype != np.float32:
            accessor["normalized"] = True
        if bounds:
            rows = values.reshape(len(values), -1)
            accessor |= {"min": rows.min(0).tolist(), "max": rows.max(0).tolist()}
        accessors.append(accessor)
        return len(accessors) - 1

    def node(self, name: str, parent: int | None = None, **fields: Any) -> int:
        """Return the number of a new node."""
        self.nodes.append({"name": name} | fields)
        if parent is not None:
            self.nodes[parent].setdefault("children", []).append(len(self.nodes) - 1)
        return len(self.nodes) - 1

    def packed(self) -> bytes:
        """Return the file."""
        self.content["buffers"] = [{"byteLength": len(self.binary)}]
        text = json.dumps(self.content | {"nodes": self.nodes}, separators=(",", ":"), allow_nan=False).encode()
        text += b" " * (-len(text) % 4)
        size = 12 + 8 + len(text) + 8 + len(self.binary)
        chunks = struct.pack("<I4s", len(text), b"JSON"), text, struct.pack("<I4s", len(self.binary), b"BIN\0")
        return struct.pack("<4sII", MAGIC, 2, size) + b"".join(chunks) + bytes(self.binary)


def write_glb(scene: MovingScene, camera: Camera, path: Path, unit: Unit = "m") -> None:
    """Write the scene and its camera, lengths in `unit`. Raises NeecoError where the disk refuses."""
    document = _Document(UNITS[unit])
    root = document.node("neeco", rotation=TURN.tolist())
    clock: int | None = None
    channels: list[dict[str, Any]] = []
    samplers: list[dict[str, Any]] = []
    for item in scene.nodes:  # numbered from 1 on in the file
        parent = root if item.parent is None else item.parent + 1
        node = document.node(item.name, parent, **({"extras": item.facts} if item.facts else {}))
        if item.poses is not None:  # the first at rest, all of them as an animation
            if clock is None and len(scene.times) > 1:
                clock = document.add(scene.times, bounds=True)
            rotations, places = _rotations(item.poses), (item.poses[:, :3, 3] * document.per_mm).astype(np.float32)
            document.nodes[node] |= {"rotation": rotations[0].tolist(), "translation": places[0].tolist()}
            for target, values in (("rotation", rotations), ("translation", places)):
                if clock is not None and np.ptp(values, axis=0).max() > 0:
                    samplers.append({"input": clock, "output": document.add(values), "interpolation": "LINEAR"})
                    channels.append({"sampler": len(samplers) - 1, "target": {"node": node, "path": target}})
        if item.splats is not None:
            _add_mesh(document, node, item.splats)
    pose = camera.world_from_camera.double().cpu()
    lens = {
        "yfov": 2 * math.atan(camera.height / (2 * camera.fy)),
        "aspectRatio": camera.width * camera.fy / (camera.height * camera.fx),
        "znear": document.per_mm,  # 1 mm
    }
    document.content["cameras"] = [{"name": "laparoscope", "type": "perspective", "perspective": lens}]
    rotation = _rotations((pose[:3, :3] @ CAMERA_TURN).numpy()[None])
    place = (pose[:3, 3] * document.per_mm).tolist()
    # glTF cannot state a principal point off the image's centre
    document.node("laparoscope", root, camera=0, rotation=rotation[0].tolist(), translation=place)
    document.content |= {"asset": {"version": "2.0", "generator": "neeco"}, "extensionsUsed": [EXTENSION]}
    document.content |= {"scene": 0, "scenes": [{"nodes": [root]}]}
    if channels:
        document.content["animations"] = [{"name": "states", "channels": channels, "samplers": samplers}]
    write_atomically(path, lambda temporary: temporary.write_bytes(document.packed()))


def _add_mesh(document: _Document, node: int, splats: Splats) -> None:
    """Give a node its Gaussians, in its own frame, mm."""
    colors = np.concatenate([splats.sh[:, 0] * SH_C0 + 0.5, splats.opacities[:, None]], 1)
    columns = {"SCALE": np.exp(splats.log_scales) * document.per_mm, "OPACITY": splats.opacities}
    for degree in range(splats.degree + 1):
        for order in range(2 * degree + 1):
            columns[f"SH_DEGREE_{degree}_COEF_{order}"] = splats.sh[:, degree**2 + order]
    attributes = {"POSITION": document.add((splats.means * document.per_mm).astype(np.float32), bounds=True)}
    attributes["COLOR_0"] = document.add(to_uint8(255 * colors))
    rotations = np.rint(splats.quats[:, [1, 2, 3, 0]] * np.iinfo(np.int16).max).astype(np.int16)  # to .002 degrees
    attributes[f"{EXTENSION}:ROTATION"] = document.add(rotations)
    attributes |= {f"{EXTENSION}:{name}": document.add(v.astype(np.float32)) for name, v in columns.items()}
    settings = {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}
    primitive = {"attributes": attributes, "mode": 0, "extensions": {EXTENSION: settings}}
    meshes = document.content["meshes"]
    meshes.append({"name": document.nodes[node]["name"], "primitives": [primitive]})
    document.nodes[node]["mesh"] = len(meshes) - 1


def _rotations(poses: np.ndarray) -> np.ndarray:
    """Return quaternions [T, 4] xyzw float32 of poses [T, 4, 4] or rotations [T, 3, 3], each nearer to the one before
    than its negative."""
    quats = matrix_to_quat(torch.from_numpy(np.ascontiguousarray(poses[:, :3, :3]))).numpy()[:, [1, 2, 3, 0]]
    for k in range(1, len(quats)):
        if quats[k] @ quats[k - 1] < 0:
            quats[k] = -quats[k]
    return (quats / np.linalg.norm(quats, axis=1, keepdims=True)).astype(np.float32)
