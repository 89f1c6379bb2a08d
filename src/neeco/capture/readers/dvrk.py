"""Kinematic trees of da Vinci instruments from the tool files of the dVRK (`share/tool/*.json`)."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from neeco.base.errors import NeecoError
from neeco.base.files import distinct_keys, read_text
from neeco.capture.documents import Node, RaisingReport, printable
from neeco.capture.kinematics import REVOLUTE, Array, KinematicTree, Link

READINGS = ("wrist_pitch", "wrist_yaw", "jaw")  # what drives the joints beyond the roll
MM = 1000.0  # per m
# a string, which stays, or a comment of JSON as the dVRK writes it
_STRING_OR_COMMENT = re.compile(r'("(?:[^"\\]|\\.)*")|//[^\n]*|/\*.*?\*/', re.DOTALL)
WHAT = "a tool file of the dVRK: JSON, with comments"


def read_dvrk_tool(path: Path | str, readings: Mapping[str, str] | None = None) -> KinematicTree:
    """The links beyond the roll of a tool: shaft, wrist, and two jaws on the axis of the yaw (one end effector where
    the tool has no jaws), joined by readings wrist_pitch, wrist_yaw and jaw in rad. Recorded poses are those of `tip`,
    the frame of `measured_cp`, which has no body.

    `readings`: how the recording calls any of these. Lengths become mm. The joints' frames are those of Denavit and
    Hartenberg as modified by Craig. Raises NeecoError for a file of another kind, or a name that is none of the
    readings.
    """
    path, names = Path(path), dict(readings or {})
    document = Node(_json_with_comments(path), str(path), "", RaisingReport())
    document.is_object()
    frames = document.child("DH")
    if frames.child("convention").value != "modified":
        found = printable(frames.child("convention").value)
        frames.child("convention").error(f"is {found}, not 'modified'", "give a tool file of the dVRK")
    # older files call them outer_wrist_pitch and outer_wrist_yaw
    joints = {(item.child("name").text() or "").removeprefix("outer_"): item for item in frames.child("joints").items()}
    # hooks and spatulas have an entry for jaws, too, which no force moves
    has_jaws = document.has("jaw") and document.child("jaw").child("ftmax").value != 0
    for joint in READINGS[:2]:
        if joint not in joints:
            frames.child("joints").error(f"there is no joint {joint}", "only tools with a wrist have a tree")
    known = READINGS if has_jaws else READINGS[:2]
    for given in names:
        if given not in known:
            raise NeecoError(f"{path}: readings: {given!r} is no joint of this tool; it has {', '.join(known)}")
    pitch, yaw, jaw = (names.get(joint, joint) for joint in READINGS)
    wrist, pitch_axis = _frame(joints["wrist_pitch"])
    pivot, yaw_axis = _frame(joints["wrist_yaw"])
    low, high = (joints["wrist_pitch"].child(end).number() or 0.0 for end in ("qmin", "qmax"))
    links = [Link("shaft"), Link("wrist", "shaft", REVOLUTE, wrist, pitch_axis, {pitch: 1.0}, limits=(low, high))]
    if has_jaws:
        for side, share in (("left", 0.5), ("right", -0.5)):
            links.append(Link(f"jaw_{side}", "wrist", REVOLUTE, pivot, yaw_axis, {yaw: 1.0, jaw: share}))
    else:
        links.append(Link("end_effector", "wrist", REVOLUTE, pivot, yaw_axis, {yaw: 1.0}))
    tip = pivot @ _tool_tip(document)
    return KinematicTree((*links, Link("tip", "wrist", REVOLUTE, tip, yaw_axis, {yaw: 1.0}, body=False)), "tip")


def _json_with_comments(path: Path) -> object:
    text = _STRING_OR_COMMENT.sub(lambda match: match[1] or " ", read_text(path, WHAT))
    try:
        return json.loads(text, object_pairs_hook=distinct_keys)
    except (ValueError, RecursionError) as error:
        raise NeecoError(f"{path}: not readable as {WHAT} ({error}); correct it") from None


def _frame(joint: Node) -> tuple[Array, Array]:
    """(parent_from_link [4, 4] mm at a value of 0, the axis [3] in the parent's frame) of a joint in modified
    Denavit-Hartenberg parameters: Rx(alpha) Tx(A) Rz(theta + offset) Tz(D)."""
    if joint.child("type").value != REVOLUTE:
        joint.child("type").error(f"is {printable(joint.child('type').value)}", "wrists turn: write revolute")
    numbers = [joint.child(key).number() for key in ("alpha", "A", "theta", "offset", "D")]
    alpha, length, theta, offset, depth = (0.0 if number is None else number for number in numbers)
    c, s = math.cos(alpha), math.sin(alpha)
    before = np.array([[1, 0, 0, MM * length], [0, c, -s, 0], [0, s, c, 0], [0, 0, 0, 1]], np.float64)
    c, s = math.cos(theta + offset), math.sin(theta + offset)
    turned = np.array([[c, -s, 0, 0], [s, c, 0, 0], [0, 0, 1, MM * depth], [0, 0, 0, 1]], np.float64)
    return before @ turned, before[:3, 2].copy()


def _tool_tip(document: Node) -> Array:
    """yaw_from_tip [4, 4] mm."""
    key = "tooltip_offset" if document.has("tooltip_offset") else "tooltip-offset"
    if not document.has(key):
        return np.eye(4)
    tip = document.child(key).rigid()
    assert tip is not None
    tip[:3, 3] *= MM
    return tip
