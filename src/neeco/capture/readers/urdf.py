"""Kinematic trees of instruments from URDF files (package urdfdom-py, the extra `urdf`)."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from neeco.base.errors import NeecoError, install_hint
from neeco.base.files import read_text
from neeco.capture.kinematics import FIXED, PRISMATIC, REVOLUTE, KinematicTree, Link
from neeco.geometry.rotations import rigid

MM = 1000.0  # per m
TYPES = {"fixed": FIXED, "revolute": REVOLUTE, "continuous": REVOLUTE, "prismatic": PRISMATIC}
WHAT = "a URDF file: XML (of a .xacro, what `xacro` makes of it)"
_COMMENT = re.compile(r"<!--.*?-->", re.DOTALL)  # a processed file names its source in one
_XACRO_PREFIX = re.compile(r"xmlns:([\w.-]+)\s*=\s*[\"'][^\"']*xacro[^\"']*[\"']")  # a processed file keeps it, too
_SUBSTITUTION = re.compile(r"\$\{|\$\((?:arg|find|eval|env|optenv|dirname|anon)\b")


def read_urdf(
    path: Path | str, root: str | None = None, pose_of: str | None = None, readings: Mapping[str, str] | None = None
) -> KinematicTree:
    """The links of a URDF from `root` on (by default its own), joined as it says. Recorded poses are those of the link
    `pose_of` (by default of `root`).

    Every joint is driven by the reading of its name, or as `readings` calls it; one that mimics another, by
    the other's. Lengths become mm, and so do the readings of joints that slide. Where any of the links has something
    visual, those without are frames only. Raises NeecoError for a file of another kind, a joint that neither turns nor
    slides, or a name that is none of the links or joints.
    """
    path, names = Path(path), dict(readings or {})
    robot = _parse(path)
    if not robot.links:
        raise NeecoError(f"{path}: defines no link; give the robot's URDF")
    children: dict[str, list[Any]] = {}
    known = {link.name: link for link in robot.links}
    for joint in robot.joints:
        children.setdefault(joint.parent, []).append(joint)
        for name in (joint.parent, joint.child):
            if name not in known:
                raise NeecoError(
                    f"{path}: joint {joint.name!r} joins {name!r}, which is no link; add it, or correct it"
                )
    carried = {joint.child for joint in robot.joints}
    tops = [name for name in known if name not in carried]
    for what, name in (("root", root), ("pose_of", pose_of)):
        if name is not None and name not in known:
            raise NeecoError(f"{path}: {what}: there is no link {name!r}; name one of {', '.join(known)}")
    if root is None and len(tops) != 1:
        raise NeecoError(f"{path}: one link has no parent, the root; found {', '.join(tops) or 'none'}; name `root`")
    first = tops[0] if root is None else root
    assert first is not None
    reached = [(first, None), *((joint.child, joint) for joint in _below(first, children, path))]
    for what, defined in (("link", [link.name for link in robot.links]), ("joint", [j.name for j in robot.joints])):
        if twice := next((name for name in defined if defined.count(name) > 1), None):
            raise NeecoError(f"{path}: {what} {twice!r} is defined twice; rename one of them")
    moving = {joint.name for _, joint in reached if joint is not None and TYPES.get(joint.type) != FIXED}
    for given in names:
        if given not in moving:
            raise NeecoError(f"{path}: readings: {given!r} is no joint that moves; it has {', '.join(sorted(moving))}")
    visible = {name for name, _ in reached if known[name].visuals}
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
    text = read_text(path, WHAT)
    _refuse_xacro(path, text)
    core.on_error = lambda message: None  # of tags that it does not know, which it would print
    try:
        return urdf.URDF.from_xml_string(text.encode())
    # the package raises ParseError, lxml's XMLSyntaxError, AssertionError and others
    except Exception as error:
        reason = " ".join(str(error).split())[:120] or type(error).__name__
        raise NeecoError(f"{path}: not readable as {WHAT} ({reason}); correct it") from None


def _refuse_xacro(path: Path, text: str) -> None:
    """Raise NeecoError for unprocessed xacro, of which a URDF parser would read what lies outside its macros."""
    text = _COMMENT.sub("", text)
    prefixes = "|".join(map(re.escape, {"xacro", *_XACRO_PREFIX.findall(text)}))
    if _SUBSTITUTION.search(text) or re.search(rf"[<\s/](?:{prefixes}):[\w.-]+[\s=/>]", text):
        stem = path.name.removesuffix(".xacro").removesuffix(".urdf")
        target = f"{stem}.urdf" if path.suffix == ".xacro" else f"{stem}_processed.urdf"
        raise NeecoError(f"{path}: is xacro; run `xacro {path.name} > {target}` and give that")


def _below(first: str, children: Mapping[str, list[Any]], path: Path) -> Iterator[Any]:
    """Joints beyond a link, parents first. Raises NeecoError where they lead in a circle."""
    waiting, met = [first], {first}
    while waiting:
        for joint in children.get(waiting.pop(0), []):
            if joint.child in met:
                raise NeecoError(f"{path}: {joint.child!r} is reached twice; every link needs one way to the root")
            met.add(joint.child)
            waiting.append(joint.child)
            yield joint


def _link(joint: Any, joints: Mapping[str, Any], names: Mapping[str, str], body: bool, path: Path) -> Link:
    if joint.type not in TYPES:
        raise NeecoError(f"{path}: joint {joint.name!r} is {joint.type}; {', '.join(TYPES)} can be had")
    kind, origin = TYPES[joint.type], np.eye(4)
    if joint.origin is not None:
        turn = Rotation.from_euler("xyz", joint.origin.rpy or [0, 0, 0]).as_matrix()
        origin = rigid(turn, MM * np.array(joint.origin.xyz or [0, 0, 0], np.float64))
    if kind == FIXED:
        return Link(joint.child, joint.parent, FIXED, origin, body=body)
    axis = np.array(joint.axis or [1.0, 0.0, 0.0], np.float64)  # URDF's own default
    length = float(np.linalg.norm(axis))
    if not 1e-6 < length < 1e6:
        raise NeecoError(f"{path}: joint {joint.name!r}: its axis is no direction; give three numbers, not all 0")
    axis = origin[:3, :3] @ (axis / length)
    unit = MM if kind == PRISMATIC else 1.0
    limit = joint.limit
    limits = None if limit is None or joint.type == "continuous" else _limits(limit, unit, joint.name, path)
    driver, gain, offset = joint.name, 1.0, 0.0
    if joint.mimic is not None:
        driver = joint.mimic.joint
        if driver not in joints or joints[driver].mimic is not None:
            raise NeecoError(
                f"{path}: joint {joint.name!r} mimics {driver!r}; name a joint beyond the root that is driven"
            )
        of_driver = MM if TYPES.get(joints[driver].type) == PRISMATIC else 1.0
        gain = (1.0 if joint.mimic.multiplier is None else float(joint.mimic.multiplier)) * unit / of_driver
        offset = unit * float(joint.mimic.offset or 0.0)
    value = {names.get(driver, driver): gain}
    return Link(joint.child, joint.parent, kind, origin, axis, value, offset=offset, limits=limits, body=body)


def _limits(limit: Any, unit: float, name: str, path: Path) -> tuple[float, float] | None:
    low, high = unit * float(limit.lower or 0.0), unit * float(limit.upper or 0.0)
    if low == high == 0.0:  # URDF's own default: none stated
        return None
    if not (math.isfinite(low) and math.isfinite(high) and low < high):
        raise NeecoError(f"{path}: joint {name!r}: its limits {low:g} to {high:g} are no range; correct them")
    return low, high
