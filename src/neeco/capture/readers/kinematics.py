"""The kinematics block of an instrument in transforms.json, which `KinematicTree.to_json` writes.

`{"pose_of": NAME, "links": [{"name", "parent", "type", "origin", "axis", "value": {reading: gain}, "offset", "limits",
"body"}]}`, as `Link` has them; all but a link's name may be left out where it is as `Link` says.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from neeco.base.errors import NeecoError
from neeco.capture.documents import Node, RaisingReport, printable
from neeco.capture.kinematics import FIXED, JOINT_TYPES, Array, KinematicTree, Link

MAX_MM = 1e4  # beyond any instrument
MAX_GAIN = 1e3
UNIT_TOLERANCE = 1e-12  # of the length of a unit vector of float64


def parse_kinematics(node: Node) -> KinematicTree | None:
    """The tree that a node describes; None, and reported, where that is none."""
    if not node.is_object():
        return None
    links = [_parse_link(item) for item in node.child("links").items()]
    pose_of = node.child("pose_of").text() if node.has("pose_of") else None
    known = tuple(link for link in links if link is not None)
    if len(known) < len(links) or not isinstance(node.child("links").value, list):
        return None
    if node.has("pose_of") and pose_of is None:
        return None
    try:
        return KinematicTree(known, pose_of)
    except NeecoError as error:
        node.child("links").error_from(error)
        return None


def kinematics_of(value: Any, file: str) -> KinematicTree:
    """The tree of a plain dict, as in a JSON or YAML file. Raises NeecoError naming `file` and the field."""
    tree = parse_kinematics(Node(value, file, "kinematics", RaisingReport()))
    assert tree is not None
    return tree


def _parse_link(node: Node) -> Link | None:
    if not node.is_object():
        return None
    name = node.child("name").text()
    parent = node.child("parent").text() if node.has("parent") else None
    given = node.child("type")
    kind = given.text() if node.has("type") else FIXED
    if kind is not None and kind not in JOINT_TYPES:
        given.error(f"is {printable(kind)}", f"write {', '.join(JOINT_TYPES)}")
        kind = None
    origin = _origin(node.child("origin")) if node.has("origin") else np.eye(4)
    axis = _axis(node.child("axis")) if node.has("axis") else np.array([0.0, 0.0, 1.0])
    value = _gains(node.child("value")) if node.has("value") else {}
    offset = node.child("offset").number(above=-MAX_MM, below=MAX_MM) if node.has("offset") else 0.0
    limits = node.child("limits").range("rad or mm") if node.has("limits") else None
    body = node.child("body")
    if node.has("body") and not isinstance(body.value, bool):
        body.error(f"expected true or false, found {printable(body.value)}", "correct it")
        return None
    if kind not in (None, FIXED) and not node.has("axis"):
        node.child("axis").error("is missing", "give the joint's axis in the parent's frame, three numbers")
        return None
    wrong = (node.has("parent") and parent is None) or (node.has("limits") and limits is None)
    if name is None or kind is None or origin is None or axis is None or value is None or offset is None or wrong:
        return None
    return Link(name, parent, kind, origin, axis, value, offset=offset, limits=limits, body=body.value is not False)


def _origin(node: Node) -> Array | None:
    """parent_from_link of three numbers (mm) or a rigid transform."""
    if isinstance(node.value, list) and any(isinstance(row, list) for row in node.value):
        return node.rigid()
    place = node.numbers(3, "x, y, z in mm")
    if place is None:
        return None
    if max(map(abs, place)) > MAX_MM:
        node.error(f"lies {max(map(abs, place)):g} mm away", "give it in mm, in the parent's frame")
        return None
    origin = np.eye(4)
    origin[:3, 3] = place
    return origin


def _axis(node: Node) -> Array | None:
    given = node.numbers(3, "x, y, z of the axis in the parent's frame")
    if given is None:
        return None
    length = math.hypot(*given)
    if not 1e-6 < length < 1e6:
        node.error("is no direction", "give three numbers that are not all 0")
        return None
    if (
        abs(length - 1) < UNIT_TOLERANCE
    ):  # as written by us: divided again, its last digits would change with every reading
        return np.array(given)
    return np.array(given) / length


def _gains(node: Node) -> dict[str, float] | None:
    if not node.is_object():
        return None
    found = {name: node.child(name).number(above=-MAX_GAIN, below=MAX_GAIN) for name in node.value}
    known = {name: gain for name, gain in found.items() if gain is not None}
    return known if len(known) == len(found) else None
