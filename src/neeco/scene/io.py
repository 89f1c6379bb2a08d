"""Scenes on disk: one safetensors file, complete in itself."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from neeco import __version__
from neeco.capture.model import Camera, Instrument, InstrumentState, State
from neeco.errors import NeecoError
from neeco.files import write_atomically
from neeco.scene.drawable import Learned
from neeco.scene.method import Stored
from neeco.scene.methods import method_class, method_settings
from neeco.scene.recorded import Recorded
from neeco.scene.scene import Scene
from neeco.settings import plain

SCHEMA = "neeco-scene/2"
BEFORE_SHADOWS = "neeco-scene/1"  # read as scenes that cast none, with readings counted from zero
SINCE = {
    "shadow_offsets",
    "shadow_strengths",
    "shadow_width",
    "middle",
    "closed",
    "radius",
    "tips",
}  # modules' tensors that it lacks


def save_scene(scene: Learned, path: Path) -> None:
    """Write `scene` atomically. The same scene gives the same bytes."""
    tensors, header = pack_scene(scene)
    save_tensors(tensors, {"neeco": json.dumps(header, sort_keys=True)}, path)


def save_tensors(tensors: dict[str, Tensor], metadata: dict[str, str], path: Path) -> None:
    """Write a safetensors file atomically. Raises NeecoError when the disk refuses."""

    def write(temporary: Path) -> None:
        try:
            save_file(tensors, temporary, metadata)
        except SafetensorError as error:
            raise OSError(str(error)) from error

    write_atomically(path, write)


def load_scene(path: Path) -> Learned:
    """Read what `save_scene` wrote. Raises NeecoError when absent, damaged or of another schema."""
    path = Path(path)
    if not path.is_file():
        raise NeecoError(f"{path}: no such scene; has training finished?")
    try:
        with safe_open(path, framework="pt") as stream:
            header = json.loads((stream.metadata() or {})["neeco"])
            tensors = {name: stream.get_tensor(name) for name in stream.keys()}  # noqa: SIM118
    except (SafetensorError, OSError, KeyError, ValueError) as error:
        raise NeecoError(f"{path}: not a readable neeco scene ({error}); train again") from None
    if header.get("schema") not in (SCHEMA, BEFORE_SHADOWS):
        raise NeecoError(f"{path}: schema {header.get('schema')!r}, this version reads {SCHEMA!r}; train again")
    try:
        return unpack_scene(tensors, header)
    except NeecoError as error:
        raise NeecoError(f"{path}: {error}; train again") from None
    except (LookupError, ValueError, TypeError, RuntimeError) as error:
        said = " ".join(str(error).split())
        raise NeecoError(f"{path}: damaged scene ({said}); train again") from None


def pack_scene(scene: Learned) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """(tensors, JSON-able header) from which `unpack_scene` makes the scene again."""
    recorded = scene.recorded
    tensors = {f"module.{name}": tensor for name, tensor in scene.state_dict().items()}
    if recorded.states:
        tensors["recorded.cameras"] = torch.stack([camera.world_from_camera for camera in recorded.cameras])
        names = [instrument.name for instrument in scene.instruments]
        if names:
            poses = [torch.stack([state.instruments[name].pose for name in names]) for state in recorded.states]
            tensors["recorded.poses"] = torch.stack(poses)
    header: dict[str, Any] = {
        "schema": SCHEMA,
        "version": __version__,
        "method": scene.method,
        "diagnostics": scene.diagnostics,
        "instruments": [
            {"name": instrument.name, "joints": {name: limits for name, limits in instrument.joints.items()}}
            for instrument in scene.instruments
        ],
        "recorded": [
            {
                "name": name,
                "split": split,
                "time": state.time,
                "joints": {key: dict(value.joints) for key, value in state.instruments.items()},
                "intrinsics": [camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height, camera.near],
            }
            for name, split, state, camera in zip(
                recorded.names, recorded.splits, recorded.states, recorded.cameras, strict=True
            )
        ],
    }
    own_tensors, own_fields = scene.pack()
    tensors |= own_tensors
    header |= {"deformation": plain(scene.settings)} | own_fields
    return {name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}, header


def unpack_scene(tensors: dict[str, Tensor], header: dict[str, Any]) -> Learned:
    """The inverse of `pack_scene`; which kind of scene, the header's method says."""
    instruments, recorded = _recording(tensors, header)
    method = header["method"]
    settings = method_settings(method, header["deformation"])
    scene = method_class(method).load(Stored(settings, instruments, recorded, tensors, header, Scene.load))
    scene.diagnostics = header["diagnostics"]
    module = {name.removeprefix("module."): t for name, t in tensors.items() if name.startswith("module.")}
    if header.get("schema") == BEFORE_SHADOWS:
        module = {n: t for n, t in scene.state_dict().items() if n.rsplit(".", 1)[-1] in SINCE} | module
    scene.load_state_dict(module)
    scene.requires_grad_(False)
    return scene


def _recording(tensors: dict[str, Tensor], header: dict[str, Any]) -> tuple[tuple[Instrument, ...], Recorded]:
    """The instruments, and what the scene was learned from."""
    instruments = tuple(
        Instrument(
            entry["name"],
            {name: tuple(limits) if limits is not None else None for name, limits in entry["joints"].items()},
        )
        for entry in header["instruments"]
    )
    states, cameras = [], []
    for index, entry in enumerate(header["recorded"]):
        moved = {
            instrument.name: InstrumentState(tensors["recorded.poses"][index, k], entry["joints"][instrument.name])
            for k, instrument in enumerate(instruments)
        }
        states.append(State(moved, entry["time"]))
        fx, fy, cx, cy, width, height, near = entry["intrinsics"]
        cameras.append(Camera(tensors["recorded.cameras"][index], fx, fy, cx, cy, int(width), int(height), near))
    recorded = Recorded(
        tuple(entry["name"] for entry in header["recorded"]),
        tuple(entry["split"] for entry in header["recorded"]),
        tuple(states),
        tuple(cameras),
    )
    return instruments, recorded
