"""`neeco export --format glb`: a scene that moves, as binary glTF 2.0 with the extension KHR_gaussian_splatting.

One node per part of each link, with which its Gaussians and their harmonics turn; the poses and joints of a sequence of
states are animation channels. Gaussians that blend links follow the link of most weight from the first state on.
Positions are in metres; the root turns the capture's world (right, down, front) by 180 degrees about z to glTF's axes.
Lamps and shadows are not part of glTF: light is baked into the colours as one camera observes the first state, without
shadows. Moving tissue rests.
"""

from __future__ import annotations

import json
import math
import struct
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch.nn.functional import normalize

from neeco.base.errors import NeecoError
from neeco.base.files import write_atomically
from neeco.capture.model import Camera, Instrument, State
from neeco.capture.readers import read_states
from neeco.evaluation.image_metrics import to_uint8
from neeco.geometry.rotations import matrix_to_quat, quat_multiply, rotate_about
from neeco.raster.reference import SH_C0
from neeco.scene import GaussianScene
from neeco.scene.drawable import ArticulatedMotion
from neeco.viewer.splats import lit_harmonics

EXTENSION = "KHR_gaussian_splatting"
ROTATION = f"{EXTENSION}:ROTATION"


@dataclass(frozen=True, kw_only=True)
class GltfSettings:
    """Settings of the file."""

    metres: float = 0.001  # per mm
    frame_s: float = 1 / 15  # between states without increasing times
    near_m: float = 0.001  # the camera's near plane
    least_weight: float = 0.9  # of a link, below which a Gaussian blends links


GLTF = GltfSettings()
MAGIC = b"glTF"
COMPONENTS = {"float32": 5126, "uint8": 5121}
TYPES = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}
TURN = np.array([0.0, 0.0, 1.0, 0.0])  # xyzw: 180 degrees about z, from the capture's axes to glTF's
CAMERA_TURN = torch.diag(torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64))  # glTF's cameras look along -z


@dataclass
class _Document:
    """JSON and binary chunk while they are put together."""

    content: dict[str, Any] = field(default_factory=lambda: {"accessors": [], "bufferViews": [], "meshes": []})
    nodes: list[dict[str, Any]] = field(default_factory=list)
    binary: bytearray = field(default_factory=bytearray)

    def add(self, values: np.ndarray, *, bounds: bool = False) -> int:
        """Return the number of an accessor of values [M, K] or [M], float32 or normalised uint8."""
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
        if values.dtype == np.uint8:
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


def exported_states(scene: GaussianScene, first: State, states: Path | None) -> list[State]:
    """Return the states of a file, or those recorded for training in the order of their times; `first` alone where no
    instrument moves."""
    if not scene.instruments:
        return [first]
    if states is not None:
        return [line.state for line in read_states(states, scene.recorded.with_limits(scene.instruments))]
    return sorted(scene.recorded.states, key=lambda state: state.time)


def write_glb(scene: GaussianScene, states: Sequence[State], camera: Camera, path: Path) -> str:
    """Write the scene, moving through `states`, lit as `camera` observes the first one; return what to tell of it.

    Raises NeecoError where the scene's method has no joints to move by, its numbers are not finite, or the disk
    refuses.
    """
    motion = scene.motion()
    if motion is None:
        raise NeecoError(f"--format: method {scene.method} asks a network for every state, which glb cannot; use ply")
    document = _described(scene, motion, states, camera)
    try:
        data = document.packed()
    except ValueError:
        raise NeecoError("the scene's Gaussians are not finite; give another state, or train again") from None
    write_atomically(path, lambda temporary: temporary.write_bytes(data))
    blended = [weights.max(1).values < GLTF.least_weight for weights, _ in motion.links]
    share = float(torch.cat(blended).float().mean()) if blended else 0.0
    return f"{len(states)} states; {share:.0%} of the instruments' Gaussians blend links and follow one of them"


@torch.no_grad()
def _described(scene: GaussianScene, motion: ArticulatedMotion, states: Sequence[State], camera: Camera) -> _Document:
    document, splats = _Document(), _attributes(scene, states[0], camera)
    root = document.node("neeco", rotation=TURN.tolist())
    counts = scene.canonical.counts
    _mesh_node(document, splats, np.arange(counts[0]), np.eye(4), document.node("tissue", root))
    corrected = [scene.registered(state) for state in states]
    times = times_of(states)
    clock = document.add(times, bounds=True) if len(states) > 1 else None
    channels: list[dict[str, Any]] = []
    samplers: list[dict[str, Any]] = []

    def animate(node: int, poses: np.ndarray) -> None:
        """Give a node its poses [T, 4, 4] mm: the first at rest, all of them as an animation."""
        rotations, places = _rotations(poses), (poses[:, :3, 3] * GLTF.metres).astype(np.float32)
        document.nodes[node] |= {"rotation": rotations[0].tolist(), "translation": places[0].tolist()}
        for target, values in (("rotation", rotations), ("translation", places)):
            if clock is not None and np.ptp(values, axis=0).max() > 0:
                samplers.append({"input": clock, "output": document.add(values), "interpolation": "LINEAR"})
                channels.append({"sampler": len(samplers) - 1, "target": {"node": node, "path": target}})

    labels = scene.label_channels().cpu().numpy()
    for number, instrument in enumerate(scene.instruments):
        rows = np.arange(len(scene.canonical))[scene.canonical.body(number + 1)]
        held = [state.instruments[instrument.name] for state in corrected]
        body = document.node(instrument.name, root, extras=_facts(instrument, motion, number))
        bodies = np.stack([item.pose.double().cpu().numpy() for item in held])
        animate(body, bodies)
        columns = [k for k, (name, _) in enumerate(scene.label_names) if name == instrument.name]
        links = motion.links[number][0].argmax(1).cpu().numpy()
        for link in np.unique(links):
            own = rows[links == link]
            parts = labels[np.ix_(own, columns)].argmax(1) if columns else np.zeros(len(own), int)
            poses = np.stack([_link_pose(motion, number, int(link), item.joints) for item in held])
            for part in np.unique(parts):
                title = scene.label_names[columns[part]][1] if columns else f"link {link}"
                extras = {"instrument": instrument.name, "part": title, "link": int(link)}
                node = document.node(title, body, extras=extras)
                animate(node, poses)
                _mesh_node(document, splats, own[parts == part], bodies[0] @ poses[0], node)
    _add_camera(document, camera, root)
    document.content |= {"asset": {"version": "2.0", "generator": "neeco"}, "extensionsUsed": [EXTENSION]}
    document.content |= {"scene": 0, "scenes": [{"nodes": [root]}]}
    if channels:
        document.content["animations"] = [{"name": "states", "channels": channels, "samplers": samplers}]
    return document


def _attributes(scene: GaussianScene, state: State, camera: Camera) -> dict[str, np.ndarray]:
    """Return the vertex attributes [N, …] of all Gaussians in `state`: positions (mm) and rotations in the world,
    harmonics in the frames that they turn with."""
    posed = scene.at(state)
    sh = lit_harmonics(posed, camera)
    found = {
        "POSITION": posed.means,
        "ROTATION": normalize(posed.quats, dim=1)[:, [1, 2, 3, 0]],
        "SCALE": posed.scales * GLTF.metres,
        "OPACITY": posed.opacities.clamp(0, 1),
    }
    degrees = int(sh.shape[1] ** 0.5)
    for degree in range(degrees):
        for order in range(2 * degree + 1):
            found[f"SH_DEGREE_{degree}_COEF_{order}"] = sh[:, degree**2 + order]
    arrays = {name: tensor.float().cpu().numpy() for name, tensor in found.items()}
    if not all(np.isfinite(values).all() for values in arrays.values()):
        raise NeecoError("the scene's Gaussians are not finite; give another state, or train again")
    shown = np.concatenate([arrays["SH_DEGREE_0_COEF_0"] * SH_C0 + 0.5, arrays["OPACITY"][:, None]], 1)
    prefixed = {name if name == "POSITION" else f"{EXTENSION}:{name}": values for name, values in arrays.items()}
    return prefixed | {"COLOR_0": to_uint8(255 * shown)}


def _mesh_node(
    document: _Document, splats: dict[str, np.ndarray], rows: np.ndarray, world_from_node: np.ndarray, node: int
) -> None:
    """Give a node, at world_from_node [4, 4] mm in the first state, the Gaussians `rows`."""
    own = {name: values[rows] for name, values in splats.items()}
    rotation, translation = world_from_node[:3, :3], world_from_node[:3, 3]
    own["POSITION"] = (((own["POSITION"] - translation) @ rotation) * GLTF.metres).astype(np.float32)
    back = matrix_to_quat(torch.from_numpy(rotation.T.copy())).expand(len(rows), 4)
    turned = quat_multiply(back, torch.from_numpy(own[ROTATION][:, [3, 0, 1, 2]]).double())
    own[ROTATION] = turned.numpy()[:, [1, 2, 3, 0]].astype(np.float32)
    attributes = {name: document.add(values, bounds=name == "POSITION") for name, values in own.items()}
    settings = {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}
    primitive = {"attributes": attributes, "mode": 0, "extensions": {EXTENSION: settings}}
    meshes = document.content["meshes"]
    meshes.append({"name": document.nodes[node]["name"], "primitives": [primitive]})
    document.nodes[node]["mesh"] = len(meshes) - 1


def _facts(instrument: Instrument, motion: ArticulatedMotion, number: int) -> dict[str, Any]:
    """Return joints, their limits (rad or mm) and the axes (mm, instrument frame) that they move links by: a link's
    turn or shift about an axis is at_zero + per_unit * joint."""
    axes = [
        {
            "joint": axis.reading,
            "type": "prismatic" if axis.slides else "revolute",
            "pivot_mm": axis.pivot.tolist(),
            "axis": axis.axis.tolist(),
            "at_zero": motion.links[number][1][:, k, 0].tolist(),
            "per_unit": motion.links[number][1][:, k, 1].tolist(),
        }
        for k, axis in enumerate(motion.axes[number])
    ]
    joints = {name: {"limits": None if limits is None else list(limits)} for name, limits in instrument.joints.items()}
    return {"instrument": instrument.name, "joints": joints, "axes": axes}


def _link_pose(motion: ArticulatedMotion, number: int, link: int, joints: Any) -> np.ndarray:
    """Return instrument_from_link [4, 4] mm: all axes in their order, by this link's amounts."""
    points = torch.cat([torch.zeros(1, 3), torch.eye(3)]).double()
    for axis, amounts in zip(motion.axes[number], motion.links[number][1][link].double().cpu(), strict=True):
        moved = amounts[0] + amounts[1] * float(joints[axis.reading])
        direction, pivot = axis.axis.double().cpu(), axis.pivot.double().cpu()
        points = points + moved * direction if axis.slides else rotate_about(points, direction, pivot, moved.expand(4))
    pose = np.eye(4)
    pose[:3, 3] = points[0].numpy()
    pose[:3, :3] = (points[1:] - points[0]).T.numpy()
    return pose


def _rotations(poses: np.ndarray) -> np.ndarray:
    """Return quaternions [T, 4] xyzw float32 of poses [T, 4, 4], each nearer to the one before than its negative."""
    quats = matrix_to_quat(torch.from_numpy(np.ascontiguousarray(poses[:, :3, :3]))).numpy()[:, [1, 2, 3, 0]]
    for k in range(1, len(quats)):
        if quats[k] @ quats[k - 1] < 0:
            quats[k] = -quats[k]
    return (quats / np.linalg.norm(quats, axis=1, keepdims=True)).astype(np.float32)


def times_of(states: Sequence[State]) -> np.ndarray:
    """Return the states' times [T] s from 0 on; GLTF.frame_s apart where they state none that increase."""
    times = np.array([float(state.time) for state in states])
    if not (np.diff(times) > 0).all():
        times = GLTF.frame_s * np.arange(len(states))
    return (times - times[0]).astype(np.float32)


def _add_camera(document: _Document, camera: Camera, root: int) -> None:
    """Add the camera at its pose; glTF cannot state a principal point off the image's centre."""
    pose = camera.world_from_camera.double().cpu()
    lens = {
        "yfov": 2 * math.atan(camera.height / (2 * camera.fy)),
        "aspectRatio": camera.width * camera.fy / (camera.height * camera.fx),
        "znear": GLTF.near_m,
    }
    document.content["cameras"] = [{"name": "laparoscope", "type": "perspective", "perspective": lens}]
    rotation = _rotations(
        np.stack([np.block([[(pose[:3, :3] @ CAMERA_TURN).numpy(), np.zeros((3, 1))], [np.eye(4)[3:]]])])
    )
    place = (pose[:3, 3] * GLTF.metres).tolist()
    document.node("laparoscope", root, camera=0, rotation=rotation[0].tolist(), translation=place)
