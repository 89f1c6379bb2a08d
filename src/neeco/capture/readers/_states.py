"""Instrument states in JSON: in the frames of a transforms file, and in files with one state per line.

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
from neeco.base.settings import faults_in
from neeco.capture.documents import Node, printable
from neeco.capture.model import BaseUncertainty, Frame, FromVideo, Instrument, InstrumentState, State, Uncertainty
from neeco.capture.readers.kinematics import parse_kinematics
from neeco.geometry.conventions import swap_camera_axes

Limits = tuple[float, float] | None


@dataclass(frozen=True)
class StateLine:
    """One line: a state and optionally the camera that observes it."""

    state: State
    world_from_camera: np.ndarray | None  # [4, 4], OpenCV axes


def read_states(path: Path, instruments: Sequence[Instrument]) -> list[StateLine]:
    """Read and check a file of states against the scene's instruments.

    Raises NeecoError naming file, line and field: unreadable, not JSON, an instrument or joint missing or unknown, a
    pose that is not rigid, a joint outside its limits.
    """
    missing = "no such file; give a file of states"
    states = []
    for number, line in enumerate(read_text(Path(path), "one JSON object per line", missing).split("\n"), 1):
        where = f"{path}: line {number}"
        if not line.strip():
            continue
        try:
            value = json.loads(line, object_pairs_hook=distinct_keys)
        except RepeatedKeyError as error:
            raise NeecoError(f"{where}: {error}") from None
        except (ValueError, RecursionError) as error:  # RecursionError, ValueError: endless nesting and numbers
            reason = error.msg if isinstance(error, json.JSONDecodeError) else "a number or the nesting is too large"
            raise NeecoError(f"{where}: not valid JSON: {reason}; give one JSON object per line") from None
        with faults_in(where):
            states.append(_parse_state_line(Node(value, where), instruments))
    if not states:
        raise NeecoError(f"{path}: contains no states; write one JSON object per line")
    return states


def parse_instruments(frame: Node) -> dict[str, InstrumentState] | None:
    """Return the instrument states of one frame ({} if it lists none); None, and reported, if one cannot be read."""
    if not frame.has("instruments"):
        return {}
    node = frame.child("instruments")
    states: dict[str, InstrumentState] = {}
    items = node.tried(Node.items)
    for item in items or ():
        if (named := item.tried(_parse_state)) is not None:
            name, state = named
            if name in states:
                item.child("name").error(f"{printable(name)} is listed twice", "keep one state per instrument")
                return None
            states[name] = state
    return states if items is not None and len(states) == len(items) else None


def _parse_state(item: Node) -> tuple[str, InstrumentState]:
    """Return an instrument's name and state."""
    item.members()
    name, pose = item.child("name").text(), item.child("pose").rigid()
    joints = {joint: node.number() for joint, node in item.child("joints").members(optional=True).items()}
    trust = item.given("trust", Node.number, None)
    if trust is not None and not 0 <= trust <= 1:
        item.child("trust").fail(f"is {trust:g}, must be from 0 to 1", "correct or remove it")
    uncertainty = item.given("uncertainty", lambda node: _parse_uncertainty(node, joints), None)
    return name, InstrumentState(torch.from_numpy(pose), joints, trust, uncertainty)


def declared_instruments(document: Node) -> tuple[Instrument, ...]:
    """Return the instruments of the header, with joint limits and kinematics; () if the header lists none."""
    if not document.has("instruments"):
        return ()
    instruments: dict[str, Instrument] = {}
    for item in document.child("instruments").tried(Node.items) or ():
        if (instrument := item.tried(_parse_declared)) is None:
            continue
        if instrument.name in instruments:
            message = f"{printable(instrument.name)} is declared twice"
            item.child("name").error(message, "give every instrument its own name")
        instruments[instrument.name] = instrument
    return tuple(instruments.values())


def _parse_declared(item: Node) -> Instrument:
    item.members()
    name = item.child("name").text()
    joints: dict[str, Limits] = {}
    unrecorded = []
    for joint, node in item.child("joints").members(optional=True).items():
        node.members(optional=True)
        joints[joint] = node.given("limits", lambda limits: limits.range("rad"), None)
        if not node.given("recorded", Node.flag, True):
            unrecorded.append(joint)
            if joints[joint] is None:
                node.child("limits").fail("is missing", "state the range in which to estimate the joint")
    tree = item.given("kinematics", parse_kinematics, None)
    shaft = item.given("from_video", _parse_from_video, None)
    shared = item.given("base_uncertainty", _parse_base_uncertainty, None)
    return Instrument(name, joints, tree, tuple(unrecorded), shaft, base_uncertainty=shared)


def all_instruments(frames: Iterable[Frame], declared: tuple[Instrument, ...]) -> tuple[Instrument, ...]:
    """Return declared instruments, then those named only in frames; joints likewise."""
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


def _parse_from_video(node: Node) -> FromVideo:
    """`{"shaft_diameter_mm", "working_length_mm"}`"""
    return FromVideo(node.child("shaft_diameter_mm").number(above=0), node.child("working_length_mm").number(least=0))


def _parse_base_uncertainty(node: Node) -> BaseUncertainty:
    """`{"center": [x, y, z], "covariance": 6x6}`"""
    center, covariance = node.child("center").numbers(3, "mm"), node.child("covariance")
    rows = tuple(row.numbers(6, "rad and mm") for row in covariance.items())
    matrix = np.array(rows)
    if matrix.shape != (6, 6) or not np.allclose(matrix, matrix.T) or np.linalg.eigvalsh(matrix).min() <= 0:
        covariance.fail("is not a covariance", "give 6 x 6 numbers, symmetric and positive definite")
    return BaseUncertainty(center, rows)


def _parse_uncertainty(node: Node, joints: Iterable[str]) -> Uncertainty:
    """`{"translation_mm": [x, y, z], "rotation_deg": [x, y, z], "joints_deg": {name: sd}}`, of a state with `joints`"""
    across, down, depth = node.child("translation_mm").numbers(3, "standard deviations in camera axes, mm", least=0)
    tilt, turn, roll = node.child("rotation_deg").numbers(3, "standard deviations about its x, y, z, deg", least=0)
    deviations = node.child("joints_deg").members(optional=True)
    for name, deviation in deviations.items():
        if name not in joints:
            deviation.fail("the state has no such joint", "remove it")
    named = {name: deviation.number(least=0) for name, deviation in deviations.items()}
    return Uncertainty((across, down, depth), (tilt, turn, roll), named)


def _parse_state_line(node: Node, instruments: Sequence[Instrument]) -> StateLine:
    listed = node.child("instruments")
    if not isinstance(listed.value, list):
        listed.fail("missing", 'expected {"instruments": [{"name", "pose", "joints"}]}')
    by_name = {instrument.name: instrument for instrument in instruments}
    parsed: dict[str, InstrumentState] = {}
    for item in listed.items():
        name = item.child("name")
        if not isinstance(name.value, str) or name.value not in by_name:
            name.fail(f"{name.value!r} is not in the scene", f"it has {', '.join(by_name) or 'no instruments'}")
        if name.value in parsed:
            name.fail(f"{printable(name.value)} is listed twice", "keep one state per instrument")
        parsed[name.value] = _parse_state(item)[1]
        joints = item.child("joints")
        instrument = by_name[name.value]
        if not all(joints.has(joint) for joint in instrument.joints if joint not in instrument.unrecorded):
            joints.fail(f"expected these joints, in rad: {', '.join(instrument.joints)}")
        for joint, angle in (joints.value or {}).items():
            if (fault := instrument.joint_fault(joint, angle)) is not None:
                joints.child(joint).fail(*fault)
    if missing := [name for name in by_name if name not in parsed]:
        listed.fail(f"{', '.join(missing)} missing", "give every instrument of the scene")
    camera = node.child("camera")
    if isinstance(camera.value, dict):
        camera = camera.child("transform_matrix")
    pose = None if camera.value is None else swap_camera_axes(camera.rigid())
    # in the scene's order, so that the order in the file has no effect, and without joints unknown to the scene
    states = {
        name: InstrumentState(
            parsed[name].pose,
            {joint: parsed[name].joints.get(joint, item.halfway(joint)) for joint in item.joints},
        )
        for name, item in by_name.items()
    }
    return StateLine(State(states, node.given("time", Node.number, 0.0)), pose)
