"""States written as JSON lines: read what a user gives, write what was drawn.

One state a line: `{"time": 0, "instruments": [{"name", "pose": 4x4, "joints": {name: rad}}], "camera": 4x4}`;
`camera` (world_from_camera, OpenGL axes, as in transforms.json) and `time` may be left out, other keys are ignored.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from neeco.capture.model import Instrument, InstrumentState, State
from neeco.errors import NeecoError

OPENGL_FROM_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])
RIGID_TOLERANCE = 1e-3


@dataclass(frozen=True)
class StateLine:
    """One line: a state and, when given, the camera that sees it."""

    state: State
    world_from_camera: np.ndarray | None  # [4, 4], OpenCV axes


def read_states(path: Path, instruments: Sequence[Instrument]) -> list[StateLine]:
    """Read and check a file of states against the scene's instruments.

    Raises NeecoError naming file, line and field: unreadable, not JSON, an instrument or joint missing or unknown, a
    pose that is not rigid, a joint outside its limits.
    """
    path = Path(path)
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except FileNotFoundError:
        raise NeecoError(f"{path}: no such file; --states takes inside, beyond, grid or a file of states") from None
    except OSError as error:
        raise NeecoError(f"{path}: cannot read: {error.strerror or error}") from error
    except UnicodeDecodeError:
        raise NeecoError(f"{path}: not a text file; expected one JSON object per line") from None
    states = [
        _parse_line(line, f"{path}: line {number}", instruments) for number, line in enumerate(lines, 1) if line.strip()
    ]
    if not states:
        raise NeecoError(f"{path}: no states in it; give one JSON object per line")
    return states


def state_to_json(state: State) -> dict[str, Any]:
    """The state as `read_states` takes it."""
    return {
        "time": state.time,
        "instruments": [
            {"name": name, "pose": instrument.pose.tolist(), "joints": dict(sorted(instrument.joints.items()))}
            for name, instrument in state.instruments.items()
        ],
    }


def camera_to_json(world_from_camera: np.ndarray) -> list[list[float]]:
    """world_from_camera [4, 4] with OpenCV axes, as transforms.json writes it (OpenGL axes)."""
    return (world_from_camera @ OPENGL_FROM_OPENCV + 0.0).tolist()  # + 0.0: no negative zeros


def _parse_line(text: str, where: str, instruments: Sequence[Instrument]) -> StateLine:
    try:
        value = json.loads(text)
    except json.JSONDecodeError as error:
        raise NeecoError(f"{where}: not valid JSON: {error.msg}; give one JSON object per line") from None
    if not isinstance(value, dict) or not isinstance(value.get("instruments"), list):
        raise NeecoError(f'{where}: instruments: missing; expected {{"instruments": [{{"name", "pose", "joints"}}]}}')
    time = _number(value.get("time", 0.0), f"{where}: time")
    known = {instrument.name: instrument for instrument in instruments}
    states: dict[str, InstrumentState] = {}
    for position, entry in enumerate(value["instruments"]):
        name = entry.get("name") if isinstance(entry, dict) else None
        at = f"{where}: instruments[{position}]"
        if not isinstance(name, str) or name not in known:
            raise NeecoError(f"{at}.name: {name!r} is not in the scene; it has {', '.join(known) or 'no instruments'}")
        if name in states:
            raise NeecoError(f"{at}.name: {name!r} comes twice in this line; give every instrument once")
        pose = _rigid(entry.get("pose"), f"{at}.pose")
        states[name] = InstrumentState(torch.from_numpy(pose), _joints(entry, known[name], at))
    if missing := [name for name in known if name not in states]:
        raise NeecoError(f"{where}: instruments: {', '.join(missing)} missing; give every instrument of the scene")
    camera = value.get("camera")
    if isinstance(camera, dict):
        camera = camera.get("transform_matrix")
    world_from_camera = None if camera is None else _rigid(camera, f"{where}: camera") @ OPENGL_FROM_OPENCV
    # in the scene's order, so that files list them in one order
    return StateLine(State({name: states[name] for name in known}, time), world_from_camera)


def _joints(entry: dict[str, Any], instrument: Instrument, at: str) -> dict[str, float]:
    given = entry.get("joints", {})
    # joints that the scene does not have are let pass: training drops those that say nothing about the instrument
    if not isinstance(given, dict) or not set(instrument.joints) <= set(given):
        raise NeecoError(f"{at}.joints: expected these joints, in rad: {', '.join(instrument.joints) or 'none'}")
    joints = {}
    for name, limits in instrument.joints.items():
        joints[name] = _number(given[name], f"{at}.joints.{name}")
        if limits is not None and not limits[0] - 1e-6 <= joints[name] <= limits[1] + 1e-6:
            raise NeecoError(f"{at}.joints.{name}: {joints[name]:.4g} rad is outside its limits {list(limits)}")
    return joints


def _number(value: Any, where: str) -> float:
    try:
        number = math.nan if isinstance(value, bool) or not isinstance(value, (int, float)) else float(value)
    except OverflowError:  # JSON knows integers that no float can hold
        number = math.inf
    if not math.isfinite(number):
        raise NeecoError(f"{where}: expected a finite number, not {str(value)[:20]!r}")
    return number


def _rigid(value: Any, where: str) -> np.ndarray:
    try:
        matrix = np.array(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        matrix = np.empty(0)
    if matrix.shape != (4, 4) or not np.isfinite(matrix).all():
        raise NeecoError(f"{where}: expected a 4x4 matrix of finite numbers")
    rotation = matrix[:3, :3]
    off = np.abs(rotation @ rotation.T - np.eye(3)).max()
    if off > RIGID_TOLERANCE or np.linalg.det(rotation) < 0 or not np.allclose(matrix[3], [0, 0, 0, 1], atol=1e-6):
        raise NeecoError(f"{where}: not a rigid transform (rotation and translation only)")
    return matrix
