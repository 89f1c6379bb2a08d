"""Kinematic trees: the block of transforms.json, tool files of the dVRK (`share/tool/*.json`) and URDF files.

The block, which `KinematicTree.to_json` writes, is `{"pose_of": NAME, "links": [{"name", "parent", "type", "origin",
"axis", "value": {reading: gain}, "offset", "limits", "body"}]}`, the fields of `Link`; all but a link's name have the
defaults of `Link`.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from neeco.base.errors import NeecoError, install_hint
from neeco.base.files import distinct_keys, read_text
from neeco.base.settings import Fault, faults_in
from neeco.capture.documents import Node, printable
from neeco.capture.kinematics import FIXED, JOINT_TYPES, PRISMATIC, REVOLUTE, Array, KinematicTree, Link
from neeco.geometry.rotations import rigid

MAX_MM = 1e4  # beyond any instrument
MAX_GAIN = 1e3
UNIT_TOLERANCE = 1e-12  # tolerance of the length of a unit vector in float64


def parse_kinematics(node: Node) -> KinematicTree:
    """Return the tree that a node describes. Raises Fault if it is invalid."""
    node.members()
    links, pose_of = node.child("links"), node.given("pose_of", Node.text, None)
    parsed = tuple(map(_parse_link, links.items()))
    with links.blamed():
        return KinematicTree(parsed, pose_of)


def kinematics_of(value: Any, file: str) -> KinematicTree:
    """Return the tree of a plain dict, as in a JSON or YAML file. Raises NeecoError naming `file` and the field."""
    with faults_in(file):
        return parse_kinematics(Node(value, file, "kinematics"))


def _parse_link(node: Node) -> Link:
    node.members()
    kind = node.given("type", Node.text, FIXED)
    if kind not in JOINT_TYPES:
        node.child("type").fail(f"is {printable(kind)}", f"write {', '.join(JOINT_TYPES)}")
    if kind != FIXED and not node.has("axis"):
        node.child("axis").fail("is missing", "give the joint's axis in the parent's frame, three numbers")
    gains = node.child("value").members(optional=True)
    return Link(
        node.child("name").text(),
        node.given("parent", Node.text, None),
        kind,
        node.given("origin", _origin, np.eye(4)),
        node.given("axis", _axis, np.array([0.0, 0.0, 1.0])),
        {name: gain.number(above=-MAX_GAIN, below=MAX_GAIN) for name, gain in gains.items()},
        offset=node.given("offset", lambda offset: offset.number(above=-MAX_MM, below=MAX_MM), 0.0),
        limits=node.given("limits", lambda limits: limits.range("rad or mm"), None),
        body=node.given("body", Node.flag, True),
    )


def _origin(node: Node) -> Array:
    """Return parent_from_link of three numbers (mm) or a rigid transform."""
    if isinstance(node.value, list) and any(isinstance(row, list) for row in node.value):
        return node.rigid()
    place = np.array(node.numbers(3, "x, y, z in mm"))
    if np.abs(place).max() > MAX_MM:
        node.fail(f"is {np.abs(place).max():g} mm away", "give it in mm, in the parent's frame")
    return rigid(np.eye(3), place)


def _axis(node: Node) -> Array:
    direction = np.array(node.numbers(3, "x, y, z of the axis in the parent's frame"))
    length = math.hypot(*direction)
    if not 1e-6 < length < 1e6:
        node.fail("is not a direction", "give three numbers that are not all 0")
    # unit vectors are kept: normalised again, their last digits would change with every reading of the file
    return direction if abs(length - 1) < UNIT_TOLERANCE else direction / length


DVRK_READINGS = ("wrist_pitch", "wrist_yaw", "jaw")  # readings of the joints distal to the roll
MM = 1000.0  # per m
# a string, which is kept, or a comment in the dVRK's JSON
_STRING_OR_COMMENT = re.compile(r'("(?:[^"\\]|\\.)*")|//[^\n]*|/\*.*?\*/', re.DOTALL)
DVRK_TOOL = "a tool file of the dVRK: JSON, with comments"


def read_dvrk_tool(path: Path | str, readings: Mapping[str, str] | None = None) -> KinematicTree:
    """Read the links of a tool distal to the roll: shaft, wrist, and two jaws on the yaw axis (one end effector for
    tools without jaws), with readings wrist_pitch, wrist_yaw and jaw in rad. Recorded poses are poses of `tip`, the
    frame of `measured_cp`, which has no body.

    readings: the recording's names of these readings. Lengths are converted to mm. Joint frames follow the modified
    Denavit-Hartenberg convention (Craig). Raises NeecoError for a file of another kind, or an unknown reading.
    """
    path = Path(path)
    text = _STRING_OR_COMMENT.sub(lambda match: match[1] or " ", read_text(path, DVRK_TOOL))
    try:
        document = json.loads(text, object_pairs_hook=distinct_keys)
    except (ValueError, RecursionError) as error:
        raise NeecoError(f"{path}: cannot be read as {DVRK_TOOL} ({error}); correct it") from None
    with faults_in(path):
        return _dvrk_tool(Node(document, str(path)), dict(readings or {}))


def _dvrk_tool(document: Node, names: Mapping[str, str]) -> KinematicTree:
    document.members()
    frames = document.child("DH")
    if frames.child("convention").value != "modified":
        convention = printable(frames.child("convention").value)
        frames.child("convention").fail(f"is {convention}, not 'modified'", "give a tool file of the dVRK")
    # named outer_wrist_pitch and outer_wrist_yaw in older files
    joints = {item.child("name").text().removeprefix("outer_"): item for item in frames.child("joints").items()}
    # hooks and spatulas also have an entry for jaws, with zero maximum force
    has_jaws = document.has("jaw") and document.child("jaw").child("ftmax").value != 0
    for joint in DVRK_READINGS[:2]:
        if joint not in joints:
            frames.child("joints").fail(f"there is no joint {joint}", "only tools with a wrist have a tree")
    available = DVRK_READINGS if has_jaws else DVRK_READINGS[:2]
    for name in names:
        if name not in available:
            raise Fault("readings", f"{name!r} is not a joint of this tool; choose one of: {', '.join(available)}")
    pitch, yaw, jaw = (names.get(joint, joint) for joint in DVRK_READINGS)
    wrist, pitch_axis = _frame(joints["wrist_pitch"])
    pivot, yaw_axis = _frame(joints["wrist_yaw"])
    low, high = (joints["wrist_pitch"].child(end).number() for end in ("qmin", "qmax"))
    links = [Link("shaft"), Link("wrist", "shaft", REVOLUTE, wrist, pitch_axis, {pitch: 1.0}, limits=(low, high))]
    if has_jaws:
        for side, share in (("left", 0.5), ("right", -0.5)):
            links.append(Link(f"jaw_{side}", "wrist", REVOLUTE, pivot, yaw_axis, {yaw: 1.0, jaw: share}))
    else:
        links.append(Link("end_effector", "wrist", REVOLUTE, pivot, yaw_axis, {yaw: 1.0}))
    key = "tooltip_offset" if document.has("tooltip_offset") else "tooltip-offset"
    yaw_from_tip = document.given(key, Node.rigid, np.eye(4))
    yaw_from_tip[:3, 3] *= MM
    tip = pivot @ yaw_from_tip
    return KinematicTree((*links, Link("tip", "wrist", REVOLUTE, tip, yaw_axis, {yaw: 1.0}, body=False)), "tip")


def _frame(joint: Node) -> tuple[Array, Array]:
    """Return (parent_from_link [4, 4] mm at value 0, the axis [3] in the parent's frame) of a joint in modified
    Denavit-Hartenberg parameters: Rx(alpha) Tx(A) Rz(theta + offset) Tz(D)."""
    if joint.child("type").value != REVOLUTE:
        joint.child("type").fail(f"is {printable(joint.child('type').value)}", "wrist joints must be revolute")
    alpha, length, theta, offset, depth = (joint.child(key).number() for key in ("alpha", "A", "theta", "offset", "D"))
    c, s = math.cos(alpha), math.sin(alpha)
    before = np.array([[1, 0, 0, MM * length], [0, c, -s, 0], [0, s, c, 0], [0, 0, 0, 1]], np.float64)
    c, s = math.cos(theta + offset), math.sin(theta + offset)
    turned = np.array([[c, -s, 0, 0], [s, c, 0, 0], [0, 0, 1, MM * depth], [0, 0, 0, 1]], np.float64)
    return before @ turned, before[:3, 2].copy()


TYPES = {"fixed": FIXED, "revolute": REVOLUTE, "continuous": REVOLUTE, "prismatic": PRISMATIC}
URDF = "a URDF file: XML (for a .xacro, the output of `xacro`)"
_COMMENT = re.compile(r"<!--.*?-->", re.DOTALL)  # a processed file names its source in a comment
_XACRO_PREFIX = re.compile(r"xmlns:([\w.-]+)\s*=\s*[\"'][^\"']*xacro[^\"']*[\"']")  # kept in processed files
_SUBSTITUTION = re.compile(r"\$\{|\$\((?:arg|find|eval|env|optenv|dirname|anon)\b")


def read_urdf(
    path: Path | str, root: str | None = None, pose_of: str | None = None, readings: Mapping[str, str] | None = None
) -> KinematicTree:
    """Read the links of a URDF from link `root` (default: the URDF's root). Recorded poses are poses of the link
    `pose_of` (default: `root`).

    Every joint is driven by the reading of its name, renamed by `readings`; a mimicking joint by the reading of the
    mimicked one. Lengths and readings of prismatic joints are converted to mm. If any link has a visual, links without
    one are frames without a body. Raises NeecoError for a file of another kind, an unsupported joint type, or an
    unknown link or joint.
    """
    path, names = Path(path), dict(readings or {})
    robot = _parse(path)
    if not robot.links:
        raise NeecoError(f"{path}: defines no link; give the robot's URDF")
    children: dict[str, list[Any]] = {}
    by_name = {link.name: link for link in robot.links}
    for joint in robot.joints:
        children.setdefault(joint.parent, []).append(joint)
        for name in (joint.parent, joint.child):
            if name not in by_name:
                raise NeecoError(
                    f"{path}: joint {joint.name!r} connects {name!r}, which is not a link; add or correct it"
                )
    carried = {joint.child for joint in robot.joints}
    tops = [name for name in by_name if name not in carried]
    for key, name in (("root", root), ("pose_of", pose_of)):
        if name is not None and name not in by_name:
            raise NeecoError(f"{path}: {key}: there is no link {name!r}; choose one of: {', '.join(by_name)}")
    if root is None and len(tops) != 1:
        raise NeecoError(f"{path}: expected one root link, found {', '.join(tops) or 'none'}; set `root`")
    first = tops[0] if root is None else root
    assert first is not None
    reached: list[tuple[str, Any]] = [(first, None)]  # links and the joints that carry them, parents first
    for name, _ in reached:  # which grows
        for joint in children.get(name, []):
            if any(joint.child == other for other, _ in reached):
                raise NeecoError(f"{path}: {joint.child!r} has several paths to the root; give every link one parent")
            reached.append((joint.child, joint))
    for key, defined in (("link", [link.name for link in robot.links]), ("joint", [j.name for j in robot.joints])):
        if twice := next((name for name in defined if defined.count(name) > 1), None):
            raise NeecoError(f"{path}: {key} {twice!r} is defined twice; rename one of them")
    moving = {joint.name for _, joint in reached if joint is not None and TYPES.get(joint.type) != FIXED}
    for name in names:
        if name not in moving:
            raise NeecoError(
                f"{path}: readings: {name!r} is not a moving joint; choose of: {', '.join(sorted(moving))}"
            )
    visible = {name for name, _ in reached if by_name[name].visuals}
    reached_joints = {joint.name: joint for _, joint in reached if joint is not None}
    links = []
    for name, joint in reached:
        body = name in visible or not visible
        links.append(Link(name, body=body) if joint is None else _link(joint, reached_joints, names, body, path))
    try:
        return KinematicTree(tuple(links), pose_of)
    except NeecoError as error:
        raise NeecoError(f"{path}: {error}") from None


def _parse(path: Path) -> Any:
    try:
        from urdf_parser_py import urdf
        from urdf_parser_py.xml_reflection import core
    except ImportError:
        raise NeecoError(f"{path}: needs urdfdom-py to be read; {install_hint('urdf')}") from None
    text = read_text(path, URDF)
    # unprocessed xacro, of which a URDF parser would ignore the macros
    plain = _COMMENT.sub("", text)
    prefixes = "|".join(map(re.escape, {"xacro", *_XACRO_PREFIX.findall(plain)}))
    if _SUBSTITUTION.search(plain) or re.search(rf"[<\s/](?:{prefixes}):[\w.-]+[\s=/>]", plain):
        stem = path.name.removesuffix(".xacro").removesuffix(".urdf")
        target = f"{stem}.urdf" if path.suffix == ".xacro" else f"{stem}_processed.urdf"
        raise NeecoError(f"{path}: is xacro; run `xacro {path.name} > {target}` and give the result")
    core.on_error = lambda message: None  # it would print unknown tags
    try:
        return urdf.URDF.from_xml_string(text.encode())
    # the package raises ParseError, lxml's XMLSyntaxError, AssertionError and others
    except Exception as error:
        reason = " ".join(str(error).split())[:120] or type(error).__name__
        raise NeecoError(f"{path}: cannot be read as {URDF} ({reason}); correct it") from None


def _link(joint: Any, joints: Mapping[str, Any], names: Mapping[str, str], body: bool, path: Path) -> Link:
    if joint.type not in TYPES:
        raise NeecoError(f"{path}: joint {joint.name!r} is {joint.type}; use one of: {', '.join(TYPES)}")
    kind, origin = TYPES[joint.type], np.eye(4)
    if joint.origin is not None:
        turn = Rotation.from_euler("xyz", joint.origin.rpy or [0, 0, 0]).as_matrix()
        origin = rigid(turn, MM * np.array(joint.origin.xyz or [0, 0, 0], np.float64))
    if kind == FIXED:
        return Link(joint.child, joint.parent, FIXED, origin, body=body)
    axis = np.array(joint.axis or [1.0, 0.0, 0.0], np.float64)  # URDF's own default
    length = float(np.linalg.norm(axis))
    if not 1e-6 < length < 1e6:
        raise NeecoError(f"{path}: joint {joint.name!r}: its axis is not a direction; give three numbers, not all 0")
    axis = origin[:3, :3] @ (axis / length)
    unit = MM if kind == PRISMATIC else 1.0
    limits = None
    if joint.limit is not None and joint.type != "continuous":
        low, high = unit * float(joint.limit.lower or 0.0), unit * float(joint.limit.upper or 0.0)
        if not (low == high == 0.0 or (math.isfinite(low) and math.isfinite(high) and low < high)):
            problem = f"its limits {low:g} to {high:g} are not a range; correct them"
            raise NeecoError(f"{path}: joint {joint.name!r}: {problem}")
        limits = None if low == high == 0.0 else (low, high)  # zeros are URDF's default: no limits
    driver, gain, offset = joint.name, 1.0, 0.0
    if joint.mimic is not None:
        driver = joint.mimic.joint
        if driver not in joints or joints[driver].mimic is not None:
            raise NeecoError(
                f"{path}: joint {joint.name!r} mimics {driver!r}; choose a driven joint distal to the root"
            )
        of_driver = MM if TYPES.get(joints[driver].type) == PRISMATIC else 1.0
        gain = (1.0 if joint.mimic.multiplier is None else float(joint.mimic.multiplier)) * unit / of_driver
        offset = unit * float(joint.mimic.offset or 0.0)
    value = {names.get(driver, driver): gain}
    return Link(joint.child, joint.parent, kind, origin, axis, value, offset=offset, limits=limits, body=body)
