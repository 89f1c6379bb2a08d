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
from neeco.scene.canonical import SH_COEFFICIENTS, CanonicalGaussians
from neeco.scene.methods import is_field, make_deformation, make_field
from neeco.scene.nerfies.scene import NerfScene
from neeco.scene.scene import Recording, Scene

SCHEMA = "neeco-scene/1"
CANONICAL_SHAPES = {  # of one Gaussian
    "means": (3,),
    "quats": (4,),
    "log_scales": (3,),
    "opacity_logits": (),
    "sh_dc": (1, 3),
    "sh_rest": (SH_COEFFICIENTS - 1, 3),
}


def save_scene(scene: Scene | NerfScene, path: Path) -> None:
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


def load_scene(path: Path) -> Scene | NerfScene:
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
    if header.get("schema") != SCHEMA:
        raise NeecoError(f"{path}: schema {header.get('schema')!r}, this version reads {SCHEMA!r}; train again")
    try:
        return unpack_scene(tensors, header)
    except NeecoError as error:
        raise NeecoError(f"{path}: {error}; train again") from None
    except (LookupError, ValueError, TypeError, RuntimeError) as error:
        raise NeecoError(f"{path}: damaged scene ({error}); train again") from None


def pack_scene(scene: Scene | NerfScene) -> tuple[dict[str, Tensor], dict[str, Any]]:
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
    if isinstance(scene, NerfScene):
        header["deformation"] = scene.settings.config()
    else:
        tensors |= {f"canonical.{name}": tensor for name, tensor in scene.canonical.tensors().items()}
        header["deformation"] = scene.deformation.config()
        header["counts"] = list(scene.canonical.counts)
        header["sh_degree"] = scene.sh_degree
        header["backdrop"] = scene.backdrop
    return {name: tensor.detach().contiguous() for name, tensor in tensors.items()}, header


def _canonical(tensors: dict[str, Tensor], counts: tuple[int, ...]) -> CanonicalGaussians:
    """The Gaussians, their shapes checked: what does not fit would only fail when it is drawn, or not at all."""
    if missing := [name for name in CANONICAL_SHAPES if name not in tensors]:
        raise ValueError(f"{missing[0]} is missing")
    for name, tensor in tensors.items():
        found, wanted = tuple(tensor.shape), (sum(counts), *CANONICAL_SHAPES.get(name, tensor.shape[1:]))
        if found != wanted:
            raise ValueError(f"{name} has shape {list(found)}, not {list(wanted)}")
        if not torch.isfinite(tensor).all():
            raise ValueError(f"{name} contains NaN or infinity")
    return CanonicalGaussians.from_tensors(tensors, counts)


def unpack_scene(tensors: dict[str, Tensor], header: dict[str, Any]) -> Scene | NerfScene:
    """The inverse of `pack_scene`; which kind of scene, the header's method says."""
    instruments, recorded = _recording(tensors, header)
    module = {name.removeprefix("module."): t for name, t in tensors.items() if name.startswith("module.")}
    scene: Scene | NerfScene
    if is_field(header["method"]):
        if broken := [name for name, tensor in module.items() if not torch.isfinite(tensor).all()]:
            raise ValueError(f"{broken[0]} contains NaN or infinity")
        scene = NerfScene(
            header["method"], make_field(header["method"], instruments, header["deformation"]), instruments, recorded
        )
    else:
        canonical = _canonical(
            {name.removeprefix("canonical."): t for name, t in tensors.items() if name.startswith("canonical.")},
            tuple(header["counts"]),
        )
        deformation = make_deformation(header["method"], instruments, header["deformation"])
        scene = Scene(header["method"], canonical, deformation, instruments, recorded, torch.zeros(3))
        scene.sh_degree = int(header["sh_degree"])
        scene.backdrop = float(header.get("backdrop", 0.0))  # older scenes have none
    scene.diagnostics = header["diagnostics"]
    scene.load_state_dict(module)
    scene.requires_grad_(False)
    return scene


def _recording(tensors: dict[str, Tensor], header: dict[str, Any]) -> tuple[tuple[Instrument, ...], Recording]:
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
    recorded = Recording(
        tuple(entry["name"] for entry in header["recorded"]),
        tuple(entry["split"] for entry in header["recorded"]),
        tuple(states),
        tuple(cameras),
    )
    return instruments, recorded
