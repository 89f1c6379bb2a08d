"""Scenes on disk: one self-contained safetensors file."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from neeco import __version__
from neeco.base.errors import NeecoError
from neeco.base.files import HALVES, finite, require_content, require_like, write_atomically
from neeco.base.settings import faults_in, plain
from neeco.capture.documents import Node
from neeco.capture.model import SEPARATE_TISSUES, Camera, Instrument, InstrumentState, State, share_lamps
from neeco.capture.readers import kinematics_of
from neeco.capture.readers.cameras import parse_lens
from neeco.geometry.rotations import rigid_fault
from neeco.scene.deformation import Deformation
from neeco.scene.drawable import DrawableScene, Recorded
from neeco.scene.gaussian_scene import GaussianScene, require_gaussians
from neeco.scene.method import Stored
from neeco.scene.method_registry import current_name, method_class, method_settings, without_removed

SCHEMA = "neeco-scene/2"
INTRINSICS = ("fx", "fy", "cx", "cy", "width", "height", "near")  # of a recorded camera, in file order
ADDED_SINCE = {"base_corrections", "anchors", "weights", "lengths"}  # may be absent in files of SCHEMA: zero
FORMER_ERROR_SCALE = "scale_of_state_errors"  # name of `error_scale` in diagnostics of version 0.3
MAX_REASON = 200  # characters of an error message
MAX_PIXELS = 2**26  # of a recorded image
MAX_NUMBER = 1e10  # mm, rad, s (including Unix time) or px: larger numbers indicate damage
# what stands for unknown in a tensor of that name: not every shaft has a known end
UNKNOWN = {"wrist_start": -math.inf, "radius": math.inf, "closed": math.nan, "tips": math.nan}
# errors raised for damaged files; endless nesting is a RuntimeError
DAMAGED = (SafetensorError, OSError, LookupError, ValueError, TypeError, AttributeError, RuntimeError, OverflowError)
HEADER = {  # fields of every scene's header, whatever its method
    "method": str,
    "diagnostics": {},
    "deformation": {},
    "instruments": [{"name": str, "joints": {str: ([(float, None)], None)}}],
    "recorded": [{"name": str, "split": str, "time": float, "joints": {str: {str: float}}, "intrinsics": [float]}],
}


def save_scene(scene: DrawableScene, path: Path) -> None:
    """Write `scene` atomically; the same scene gives the same bytes."""
    tensors, header = pack_scene(scene)
    save_tensors(tensors, {"neeco": json.dumps(header, sort_keys=True, allow_nan=False)}, path)


def save_tensors(tensors: dict[str, Tensor], metadata: dict[str, str], path: Path) -> None:
    """Write a safetensors file atomically. Raises NeecoError when the disk refuses."""

    def write(temporary: Path) -> None:
        try:
            save_file(tensors, temporary, metadata)
        except SafetensorError as error:
            raise OSError(str(error)) from error

    write_atomically(path, write)


def load_scene(path: Path) -> DrawableScene:
    """Read what `save_scene` wrote. Raises NeecoError when absent, damaged or of another schema."""
    path = Path(path)
    require_content(path)
    if not path.is_file():
        raise NeecoError(f"{path}: no such scene; has training finished?")
    try:
        with safe_open(path, framework="pt") as stream:
            header = json.loads((stream.metadata() or {})["neeco"])
            tensors = {name: stream.get_tensor(name) for name in stream.keys()}  # noqa: SIM118
    except DAMAGED as error:
        reason = " ".join(str(error).split())
        raise NeecoError(f"{path}: not a readable neeco scene ({reason}); train again") from None
    if not isinstance(header, dict):
        raise NeecoError(f"{path}: not a readable neeco scene (its header is no object); train again")
    if header.get("schema") != SCHEMA:
        raise NeecoError(f"{path}: schema {header.get('schema')!r}, this version reads {SCHEMA!r}; train again")
    if isinstance(tissues := header.get("tissues"), list) and len(tissues) > 1:
        raise NeecoError(f"{path}: tissues: a scene has one tissue, and this {len(tissues)}; {SEPARATE_TISSUES}")
    try:
        return unpack_scene(tensors, header)
    except NeecoError as error:
        raise NeecoError(f"{path}: {error}; train again") from None
    except DAMAGED as error:
        reason = " ".join(str(error).split())[:MAX_REASON]
        raise NeecoError(f"{path}: damaged scene ({reason}); train again") from None


def load_gaussians(path: Path, asked_by: str, device: torch.device | None = None) -> GaussianScene:
    """Read a scene of Gaussians onto `device` (None: the CPU). Raises NeecoError as `load_scene` does and, naming the
    option or verb `asked_by`, for a radiance field."""
    scene = require_gaussians(load_scene(path), asked_by)
    return scene if device is None else scene.to(device)


def pack_scene(scene: DrawableScene) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Return (tensors, JSON-able header) of a scene; `unpack_scene` is the inverse."""
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
        "diagnostics": finite(scene.diagnostics),
        "instruments": [_described(instrument) for instrument in scene.instruments],
        "recorded": [
            {
                "name": name,
                "split": split,
                "time": state.time,
                "joints": {key: dict(value.joints) for key, value in state.instruments.items()},
                "intrinsics": [getattr(camera, field) for field in INTRINSICS],
            }
            for name, split, state, camera in zip(
                recorded.names, recorded.splits, recorded.states, recorded.cameras, strict=True
            )
        ],
    }
    if recorded.lens is not None:
        header["lens"] = recorded.lens.to_json()
    if recorded.scale != 1:
        header["scale"] = recorded.scale
    if recorded.still:
        header["still"] = True
    if recorded.error_scale:
        header["error_scale"] = recorded.error_scale
    header["deformation"] = plain(scene.settings)
    own_tensors, own_fields = scene.pack()
    tensors, header = tensors | own_tensors, header | own_fields
    return {name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}, header


def unpack_scene(tensors: dict[str, Tensor], header: dict[str, Any]) -> DrawableScene:
    """Return the scene of `pack_scene`'s tensors and header, of the kind of the header's method."""
    require_like(header, HEADER, "header", "it is damaged")
    if HALVES.search(json.dumps(header, ensure_ascii=False)):
        raise ValueError("its header holds an unpaired surrogate character")
    instruments, recorded = _recording(tensors, header)
    require_numbers(tensors)
    method = header["method"] = current_name(header["method"])
    settings = method_settings(method, without_removed(header["deformation"]))
    kind = method_class(method)
    stored = Stored(settings, instruments, recorded, tensors, header)
    scene: DrawableScene = (
        GaussianScene.load(kind(instruments, settings), stored) if issubclass(kind, Deformation) else kind.load(stored)
    )
    scene.diagnostics = header["diagnostics"]
    module = {name.removeprefix("module."): t for name, t in tensors.items() if name.startswith("module.")}
    module = {n: t for n, t in scene.state_dict().items() if n.rsplit(".", 1)[-1] in ADDED_SINCE} | module
    scene.load_state_dict(module)
    json.dumps(header, allow_nan=False)  # raises ValueError for NaN and infinity
    scene.requires_grad_(False)
    return scene


def require_numbers(tensors: Mapping[str, Tensor]) -> None:
    """Raise ValueError for a tensor with a number that cannot be learned, except its UNKNOWN value."""
    for name, tensor in tensors.items():
        if tensor.is_floating_point():
            unknown = UNKNOWN.get(name.rpartition(".")[2])
            valid = tensor.abs() <= MAX_NUMBER
            if unknown is not None:
                valid |= tensor.isnan() if math.isnan(unknown) else tensor == unknown
            if not valid.all():
                raise ValueError(f"{name} contains NaN, infinity or a number beyond {MAX_NUMBER:g}")


def _recording(tensors: dict[str, Tensor], header: dict[str, Any]) -> tuple[tuple[Instrument, ...], Recorded]:
    """Return the instruments and the training frames. Raises ValueError for impossible values."""
    instruments = tuple(_instrument(entry) for entry in header["instruments"])
    states, cameras = [], []
    for index, entry in enumerate(header["recorded"]):
        moved = {
            instrument.name: InstrumentState(
                _pose(tensors["recorded.poses"][index, k], f"{instrument.name} in frame {index}"),
                {joint: _number(entry["joints"][instrument.name][joint]) for joint in instrument.joints},
            )
            for k, instrument in enumerate(instruments)
        }
        states.append(State(moved, _number(entry["time"])))
        pose = _pose(tensors["recorded.cameras"][index], f"camera in frame {index}")
        cameras.append(_camera(pose, dict(zip(INTRINSICS, map(_number, entry["intrinsics"]), strict=True))))
    names, splits = (tuple(entry[key] for entry in header["recorded"]) for key in ("name", "split"))
    with faults_in("header"):
        lens = parse_lens(Node(header["lens"], "header", "lens")) if "lens" in header else None
    scale = _number(header.get("scale", 1.0))
    if not 0 < scale <= 1:
        raise ValueError(f"its scale is {scale}, not a share of the images' size")
    still = header.get("still") is True
    lit = share_lamps(cameras) if still else tuple(cameras)
    errors = _number(header.get("error_scale", header["diagnostics"].get(FORMER_ERROR_SCALE, 0.0)))
    recorded = Recorded(names, splits, tuple(states), lit, lens=lens, scale=scale, still=still, error_scale=errors)
    return instruments, recorded


def _described(instrument: Instrument) -> dict[str, Any]:
    """Return the header's entry of an instrument; `_instrument` reads it."""
    described: dict[str, Any] = {"name": instrument.name, "joints": finite(dict(instrument.joints))}
    tree = instrument.kinematics
    described |= {} if tree is None else {"kinematics": tree.to_json()}
    described |= {"unrecorded": list(instrument.unrecorded)} if instrument.unrecorded else {}
    return described | ({"left_out": list(instrument.left_out)} if instrument.left_out else {})


def _instrument(entry: dict[str, Any]) -> Instrument:
    joints = {name: _limits(limits) for name, limits in entry["joints"].items()}
    tree = kinematics_of(entry["kinematics"], "header") if "kinematics" in entry else None
    if tree is not None and not set(tree.readings) <= set(joints):
        raise ValueError("its kinematics take readings that are not joints of it")
    unrecorded = tuple(entry.get("unrecorded", ()))
    if not set(unrecorded) <= set(joints):
        raise ValueError("its unrecorded joints are no joints of it")
    return Instrument(entry["name"], joints, tree, unrecorded, left_out=tuple(entry.get("left_out", ())))


def _number(value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) <= MAX_NUMBER:
        raise ValueError(f"{value!r} is not a number that can be recorded")
    return value


def _limits(pair: Any) -> tuple[float, float] | None:
    """Return a joint's limits; a bound may be null: infinite."""
    if pair is None:
        return None
    lower, upper = pair
    return -math.inf if lower is None else _number(lower), math.inf if upper is None else _number(upper)


def _pose(pose: Tensor, what: str) -> Tensor:
    """Return `pose` [4, 4], mm. Raises ValueError when it is not a rigid transform."""
    if tuple(pose.shape) != (4, 4) or rigid_fault(pose.double().numpy()):
        raise ValueError(f"the recorded pose of {what} is not a rigid transform")
    return pose


def _camera(pose: Tensor, values: dict[str, float]) -> Camera:
    """Return the camera of intrinsics by name (INTRINSICS). Raises ValueError for impossible ones."""
    fx, fy, width, height = values["fx"], values["fy"], values["width"], values["height"]
    if min(fx, fy, values["near"]) <= 0 or min(width, height) < 1 or width * height > MAX_PIXELS:
        raise ValueError(f"a recorded camera of {width} x {height} px and focal lengths {fx}, {fy} px is not possible")
    return Camera(pose, fx, fy, values["cx"], values["cy"], width=int(width), height=int(height), near=values["near"])
