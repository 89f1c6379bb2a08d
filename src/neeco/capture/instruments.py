"""Read instrument states and declarations from a transforms file."""

from __future__ import annotations

from collections.abc import Iterable

import torch

from neeco.capture.model import Frame, Instrument, InstrumentState
from neeco.capture.nodes import Node
from neeco.capture.problems import shown

Limits = tuple[float, float] | None
LIMIT_TOLERANCE = 1e-3  # rad (mm for sliding joints) by which rounding and noise may pass a limit


def passes_limits(value: float, limits: Limits) -> bool:
    """Whether a joint's value lies outside its limits by more than rounding explains."""
    return limits is not None and not limits[0] - LIMIT_TOLERANCE <= value <= limits[1] + LIMIT_TOLERANCE


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
        joints = _joints(item)
        if name is not None and name in states:
            item.child("name").error(f"{shown(name)} comes twice here", "keep one state per instrument")
            good = False
        if name is None or pose is None or joints is None:
            good = False
            continue
        states[name] = InstrumentState(torch.from_numpy(pose), joints)
    return states if good else None


def declared_instruments(document: Node) -> tuple[Instrument, ...]:
    """The instruments of the header, with their joints' limits; () where the header lists none."""
    if not document.has("instruments"):
        return ()
    instruments: dict[str, Instrument] = {}
    for item in document.child("instruments").items():
        if not item.is_object():
            continue
        name = item.child("name").text()
        joints = _declared_joints(item)
        if name is None:
            continue
        if name in instruments:
            item.child("name").error(f"{shown(name)} is declared twice", "give every instrument its own name")
        instruments[name] = Instrument(name, joints)
    return tuple(instruments.values())


def seen_instruments(frames: Iterable[Frame], declared: tuple[Instrument, ...]) -> tuple[Instrument, ...]:
    """Declared instruments, then those that only frames name; joints likewise."""
    joints: dict[str, dict[str, Limits]] = {item.name: dict(item.joints) for item in declared}
    for frame in frames:
        for name, state in frame.state.instruments.items():
            known = joints.setdefault(name, {})
            for joint in state.joints:
                known.setdefault(joint, None)
    return tuple(Instrument(name, limits) for name, limits in joints.items())


def _joint_nodes(item: Node) -> dict[str, Node] | None:
    """What stands under each name in `joints` ({} where there is none), or None when that is no object."""
    if not item.has("joints"):
        return {}
    node = item.child("joints")
    return {name: node.child(name) for name in node.value} if node.is_object() else None


def _joints(item: Node) -> dict[str, float] | None:
    nodes = _joint_nodes(item)
    values = {name: node.number() for name, node in (nodes or {}).items()}
    known = {name: value for name, value in values.items() if value is not None}
    return None if nodes is None or len(known) < len(values) else known


def _declared_joints(item: Node) -> dict[str, Limits]:
    joints: dict[str, Limits] = {}
    for name, joint in (_joint_nodes(item) or {}).items():
        has_limits = joint.value is not None and joint.is_object() and joint.has("limits")
        joints[name] = joint.child("limits").range("rad") if has_limits else None
    return joints
