"""States written as JSON lines: read what a user gives, write what was drawn.

One state a line: `{"time": 0, "instruments": [{"name", "pose": 4x4, "joints": {name: rad}}], "camera": 4x4}`;
`camera` (world_from_camera, OpenGL axes, as in transforms.json) and `time` may be left out, other keys are ignored.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from neeco.capture.instruments import parse_instruments, passes_limits
from neeco.capture.model import Instrument, InstrumentState, State
from neeco.capture.nodes import Node
from neeco.capture.poses import swap_camera_axes
from neeco.capture.problems import Refusal
from neeco.errors import NeecoError
from neeco.files import read_text


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
    missing = "no such file; --states takes interpolate, extrapolate, grid or a file of states"
    lines = read_text(Path(path), "one JSON object per line", missing).split("\n")
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
    return (swap_camera_axes(world_from_camera) + 0.0).tolist()  # + 0.0: no negative zeros


def _parse_line(text: str, where: str, instruments: Sequence[Instrument]) -> StateLine:
    try:
        value = json.loads(text)
    except (ValueError, RecursionError) as error:  # beside what is no JSON: endless numbers and nesting
        reason = error.msg if isinstance(error, json.JSONDecodeError) else "a number or the nesting is beyond measure"
        raise NeecoError(f"{where}: not valid JSON: {reason}; give one JSON object per line") from None
    node = Node(value, where, "", Refusal())
    if not isinstance(node.child("instruments").value, list):
        node.child("instruments").error("missing", 'expected {"instruments": [{"name", "pose", "joints"}]}')
    known = {instrument.name: instrument for instrument in instruments}
    _check_names(node, known)
    given = parse_instruments(node) or {}
    for item, name in zip(node.child("instruments").items(), given, strict=True):
        _check_joints(item, known[name])
    time = node.child("time").number() if node.has("time") else None
    camera = node.child("camera")
    if isinstance(camera.value, dict):
        camera = camera.child("transform_matrix")
    pose = None if camera.value is None else camera.rigid()
    # in the scene's order, so that files list them in one order
    states = {name: _scene_joints(given[name], known[name]) for name in known}
    return StateLine(State(states, time or 0.0), None if pose is None else swap_camera_axes(pose))


def _check_names(node: Node, known: dict[str, Instrument]) -> None:
    """Refuse instruments that the scene does not have, and lines without one that it has."""
    given = [item.child("name") for item in node.child("instruments").items()]
    for name in given:
        if not isinstance(name.value, str) or name.value not in known:
            name.error(f"{name.value!r} is not in the scene", f"it has {', '.join(known) or 'no instruments'}")
    if missing := [name for name in known if name not in [item.value for item in given]]:
        node.child("instruments").error(f"{', '.join(missing)} missing", "give every instrument of the scene")


def _check_joints(item: Node, instrument: Instrument) -> None:
    """Refuse a state without one of its instrument's joints, or with one outside its limits."""
    joints = item.child("joints")
    if not all(joints.has(joint) for joint in instrument.joints):
        joints.error(f"expected these joints, in rad: {', '.join(instrument.joints)}")
    for joint, limits in instrument.joints.items():
        if passes_limits(joints.value[joint], limits):
            joints.child(joint).error(f"{joints.value[joint]:.4g} rad is outside its limits {list(limits or ())}")


def _scene_joints(state: InstrumentState, instrument: Instrument) -> InstrumentState:
    """The state without joints that the scene does not have: training drops those that say nothing."""
    return InstrumentState(state.pose, {joint: state.joints[joint] for joint in instrument.joints})
