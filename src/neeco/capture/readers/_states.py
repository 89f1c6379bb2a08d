"""Instrument states in JSON: those of a transforms file's frames, and files of one state a line.

A line is `{"time": 0, "instruments": [{"name", "pose": 4x4, "joints": {name: rad}}], "camera": 4x4}`;
`camera` (world_from_camera, OpenGL axes, as in transforms.json) and `time` may be left out, other keys are ignored.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch

from neeco.base.errors import NeecoError
from neeco.base.files import RepeatedKeyError, distinct_keys, read_text
from neeco.capture.documents import Node, RaisingReport, printable
from neeco.capture.model import BaseUncertainty, Frame, FromVideo, Instrument, InstrumentState, State, Uncertainty
from neeco.capture.readers.kinematics import parse_kinematics
from neeco.geometry.conventions import swap_camera_axes

Limits = tuple[float, float] | None


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
    missing = "no such file; give a file of states"
    lines = read_text(Path(path), "one JSON object per line", missing).split("\n")
    states = [
        _parse_line(line, f"{path}: line {number}", instruments) for number, line in enumerate(lines, 1) if line.strip()
    ]
    if not states:
        raise NeecoError(f"{path}: no states in it; give one JSON object per line")
    return states


def parse_instruments(frame: Node) -> dict[str, InstrumentState] | None:
    """The instrument states of one frame ({} where it lists none), or None when one of them could not be read."""
    if not frame.has("instruments"):
        return {}
    node = frame.child("instruments")
    states: dict[str, InstrumentState] = {}
    good = isinstance(node.value, list)
    for item in node.items():
        if not item.is_object():
            good = False
            continue
        name = item.child("name").text()
        pose = item.child("pose").rigid()
        nodes = _joint_nodes(item)
        joints = {joint: child.number() for joint, child in (nodes or {}).items()}
        valid = {joint: value for joint, value in joints.items() if value is not None}
        trust = item.child("trust").number() if item.has("trust") else None
        if trust is not None and not 0 <= trust <= 1:
            item.child("trust").error(f"is {trust:g}, not a share", "give 0 to 1, or leave it out")
            trust = None
        uncertainty = parse_uncertainty(item.child("uncertainty"), valid) if item.has("uncertainty") else None
        if name in states:
            item.child("name").error(f"{printable(name)} comes twice here", "keep one state per instrument")
            good = False
        if name is None or pose is None or nodes is None or len(valid) < len(joints):
            good = False
            continue
        states[name] = InstrumentState(torch.from_numpy(pose), valid, trust, uncertainty)
    return states if good else None


def declared_instruments(document: Node) -> tuple[Instrument, ...]:
    """The instruments of the header, with their joints' limits and kinematics; () where the header lists none."""
    if not document.has("instruments"):
        return ()
    instruments: dict[str, Instrument] = {}
    for item in document.child("instruments").items():
        if not item.is_object():
            continue
        name = item.child("name").text()
        joints: dict[str, Limits] = {}
        unrecorded = []
        for joint, node in (_joint_nodes(item) or {}).items():
            is_object = node.value is not None and node.is_object()
            has_limits = is_object and node.has("limits")
            joints[joint] = node.child("limits").range("rad") if has_limits else None
            if is_object and node.child("recorded").flag(True) is False:
                unrecorded.append(joint)
                if not has_limits:
                    node.child("limits").error("is missing", "state between which values to look for the joint")
        if name is None:
            continue
        if name in instruments:
            item.child("name").error(f"{printable(name)} is declared twice", "give every instrument its own name")
        tree = parse_kinematics(item.child("kinematics")) if item.has("kinematics") else None
        shaft = parse_from_video(item.child("from_video")) if item.has("from_video") else None
        shared = parse_base_uncertainty(item.child("base_uncertainty")) if item.has("base_uncertainty") else None
        instruments[name] = Instrument(name, joints, tree, tuple(unrecorded), shaft, base_uncertainty=shared)
    return tuple(instruments.values())


def all_instruments(frames: Iterable[Frame], declared: tuple[Instrument, ...]) -> tuple[Instrument, ...]:
    """Declared instruments, then those that only frames name; joints likewise."""
    joints: dict[str, dict[str, Limits]] = {item.name: dict(item.joints) for item in declared}
    for frame in frames:
        for name, state in frame.state.instruments.items():
            limits = joints.setdefault(name, {})
            for joint in state.joints:
                limits.setdefault(joint, None)
    stated = {item.name: item for item in declared}
    return tuple(
        replace(stated[name], joints=limits) if name in stated else Instrument(name, limits)
        for name, limits in joints.items()
    )


def parse_from_video(node: Node) -> FromVideo | None:
    """`{"shaft_diameter_mm", "working_length_mm"}`; None, and reported, where it is not that."""
    if not node.is_object():
        return None
    diameter = node.child("shaft_diameter_mm").number(above=0)
    working = node.child("working_length_mm").number(least=0)
    return None if diameter is None or working is None else FromVideo(diameter, working)


def parse_base_uncertainty(node: Node) -> BaseUncertainty | None:
    """`{"center": [x, y, z], "covariance": 6x6}`; None, and reported, where it is not that."""
    if not node.is_object():
        return None
    center, covariance = node.child("center").numbers(3, "mm"), node.child("covariance")
    rows = [row for item in covariance.items() if (row := item.numbers(6, "rad and mm")) is not None]
    if center is None or not isinstance(covariance.value, list) or len(rows) < len(covariance.value):
        return None
    matrix = np.array(rows)
    if matrix.shape != (6, 6) or not np.allclose(matrix, matrix.T) or np.linalg.eigvalsh(matrix).min() <= 0:
        covariance.error("is no covariance", "give 6 x 6 numbers, symmetric and positive definite")
        return None
    return BaseUncertainty(tuple(center), tuple(map(tuple, rows)))


def parse_uncertainty(node: Node, joints: Iterable[str]) -> Uncertainty | None:
    """`{"translation_mm": [x, y, z], "rotation_deg": [x, y, z], "joints_deg": {name: sd}}`, of a state with `joints`;
    None, and reported, where it is not that."""
    if not node.is_object():
        return None
    translation = node.child("translation_mm").numbers(3, "standard deviations in the camera's axes, mm", least=0)
    rotation = node.child("rotation_deg").numbers(3, "deviations about the instrument's x, y, z, degrees", least=0)
    named: dict[str, float] = {}
    good = translation is not None and rotation is not None
    if node.has("joints_deg"):
        deviations = node.child("joints_deg")
        good &= deviations.is_object()
        for name in deviations.value if isinstance(deviations.value, dict) else ():
            deviation = deviations.child(name).number(least=0)
            if name not in joints:
                deviations.child(name).error("the state has no such joint", "leave it out")
                good = False
            elif deviation is None:
                good = False
            else:
                named[name] = deviation
    if not good or translation is None or rotation is None:
        return None
    (across, down, depth), (tilt, turn, roll) = translation, rotation
    return Uncertainty((across, down, depth), (tilt, turn, roll), named)


def _joint_nodes(item: Node) -> dict[str, Node] | None:
    """The values in `joints` by name ({} where there is none), or None when that is no object."""
    if not item.has("joints"):
        return {}
    node = item.child("joints")
    return {name: node.child(name) for name in node.value} if node.is_object() else None


def _parse_line(text: str, where: str, instruments: Sequence[Instrument]) -> StateLine:
    try:
        value = json.loads(text, object_pairs_hook=distinct_keys)
    except RepeatedKeyError as error:
        raise NeecoError(f"{where}: {error}") from None
    except (ValueError, RecursionError) as error:  # RecursionError, ValueError: endless nesting and numbers
        reason = error.msg if isinstance(error, json.JSONDecodeError) else "a number or the nesting is too large"
        raise NeecoError(f"{where}: not valid JSON: {reason}; give one JSON object per line") from None
    node = Node(value, where, "", RaisingReport())
    if not isinstance(node.child("instruments").value, list):
        node.child("instruments").error("missing", 'expected {"instruments": [{"name", "pose", "joints"}]}')
    by_name = {instrument.name: instrument for instrument in instruments}
    names = [item.child("name") for item in node.child("instruments").items()]
    for name in names:
        if not isinstance(name.value, str) or name.value not in by_name:
            name.error(f"{name.value!r} is not in the scene", f"it has {', '.join(by_name) or 'no instruments'}")
    if missing := [name for name in by_name if name not in [item.value for item in names]]:
        node.child("instruments").error(f"{', '.join(missing)} missing", "give every instrument of the scene")
    parsed = parse_instruments(node) or {}
    for item, instrument in zip(node.child("instruments").items(), parsed, strict=True):
        _check_joints(item, by_name[instrument])
    time = node.child("time").number() if node.has("time") else None
    camera = node.child("camera")
    if isinstance(camera.value, dict):
        camera = camera.child("transform_matrix")
    pose = None if camera.value is None else camera.rigid()
    # in the scene's order, so that files list them in one order, without joints that the scene does not have
    states = {
        name: InstrumentState(
            parsed[name].pose,
            {joint: parsed[name].joints.get(joint, item.halfway(joint)) for joint in item.joints},
        )
        for name, item in by_name.items()
    }
    return StateLine(State(states, time or 0.0), None if pose is None else swap_camera_axes(pose))


def _check_joints(item: Node, instrument: Instrument) -> None:
    """Refuse a state without one of its instrument's joints, with one that it does not have, or an impossible value."""
    joints = item.child("joints")
    if not all(joints.has(joint) for joint in instrument.joints if joint not in instrument.unrecorded):
        joints.error(f"expected these joints, in rad: {', '.join(instrument.joints)}")
    for joint, value in (joints.value or {}).items():
        if (fault := instrument.joint_fault(joint, value)) is not None:
            joints.child(joint).error(*fault)
