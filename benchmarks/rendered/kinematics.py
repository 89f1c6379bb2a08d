"""Hinge and links of a scene's instrument, in the tracked sensor's frame: as they are and as stated."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from neeco.capture.kinematics import FIXED, REVOLUTE, KinematicTree, Link
from rendered.motion import Array
from rendered.scenes import SceneSpec
from rendered.wristed import WristedDesign

JAW_LEFT, JAW_RIGHT = 3, 4
JAW_NAMES = {JAW_LEFT: "jaw_left", JAW_RIGHT: "jaw_right"}
# by which every axis and every pivot is stated wrongly
AXIS_ERROR, PIVOT_ERROR = math.radians(5.0), 2.0


def truth_ids(spec: SceneSpec) -> tuple[int, int]:
    """Part ids of the first and second jaw.

    The hinge axis is given the sign that makes its largest component in the sensor's frame positive; the left jaw
    opens towards (shaft direction x axis).
    """
    return (JAW_LEFT, JAW_RIGHT) if _sign(spec) > 0 else (JAW_RIGHT, JAW_LEFT)


def describe_hinge(spec: SceneSpec) -> dict[str, Any]:
    """truth/hinge.json: hinge and shaft in the true sensor frame (mm)."""
    sensor_from_mechanical = np.linalg.inv(spec.mount.mechanical_from_sensor())
    rotation, shift = sensor_from_mechanical[:3, :3], sensor_from_mechanical[:3, 3]
    return {
        "instrument": spec.design.name,
        "frame": "tracked sensor (truth), mm",
        "hinge_axis": (_sign(spec) * rotation[:, 0]).tolist(),
        "hinge_pivot": (rotation @ [0, 0, spec.design.hinge] + shift).tolist(),
        "shaft_origin": shift.tolist(),
        "shaft_direction": rotation[:, 2].tolist(),
        "shaft_radius_mm": spec.design.radius,
        "joint": {
            "jaw_angle": {
                "zero": spec.joint.zero,
                "sign": spec.joint.sign,
                "meaning": "reading = zero + sign * opening; opening = angle between the jaws, 0 closed",
            }
        },
    }


def _sign(spec: SceneSpec) -> int:
    axis: Array = np.linalg.inv(spec.mount.mechanical_from_sensor())[:3, 0]
    return 1 if axis[np.abs(axis).argmax()] > 0 else -1


def true_kinematics(spec: SceneSpec) -> KinematicTree:
    """The links in the true sensor frame, mm, with the encoders' offsets taken out: what a perfect search would find.
    Link frames are parallel to the sensor's where the wrist is straight and the jaws are closed."""
    design, encoders = spec.design, spec.encoders
    sensor_from_mechanical = np.linalg.inv(spec.mount.mechanical_from_sensor())
    rotation, shift = sensor_from_mechanical[:3, :3], sensor_from_mechanical[:3, 3]
    if not isinstance(design, WristedDesign):
        hinge = rotation @ np.array([0.0, 0.0, design.hinge]) + shift
        return KinematicTree((Link("shaft"), Link("wrist", "shaft"), *_jaws(spec, rotation, hinge)))
    assert encoders is not None
    first, *others = design.wrist_joints
    origin, offset = _shift(rotation @ np.array([0.0, 0.0, design.pitch_at]) + shift), -encoders.offsets[0]
    links = [Link("shaft"), Link("wrist", "shaft", REVOLUTE, origin, rotation[:, 1], {first: 1.0}, offset=offset)]
    hinge = rotation @ np.array([0.0, 0.0, design.hinge - design.pitch_at])
    return KinematicTree((*links, *_jaws(spec, rotation, hinge, others, -sum(encoders.offsets[1:]))))


def _jaws(
    spec: SceneSpec, rotation: Array, hinge: Array, others: Sequence[str] = (), offset: float = 0.0
) -> list[Link]:
    """Both jaws, of the link "wrist", about a hinge [3] in its frame; others: readings that turn both as well, less
    their offset."""
    found = []
    for part, sense, share in zip(truth_ids(spec), (-1, 1), spec.design.shares, strict=True):
        if not (others or share):
            found.append(Link(JAW_NAMES[part], "wrist", origin=_shift(hinge)))
            continue
        gain = sense * share * spec.joint.sign  # per reading of the jaw
        value = dict.fromkeys(others, 1.0) | {"jaw_angle": gain}
        own = offset - gain * spec.joint.zero
        found.append(Link(JAW_NAMES[part], "wrist", REVOLUTE, _shift(hinge), rotation[:, 0], value, offset=own))
    return found


def stated_kinematics(spec: SceneSpec, *, exact: bool = False, along_mm: float = 0.0) -> KinematicTree:
    """The links as a drawing of the instrument and a ruler on its sensor give them: axes turned by AXIS_ERROR and
    pivots shifted by PIVOT_ERROR mm, each some way of its own, unless `exact`, and encoders thought to be without an
    offset. All that the shaft carries is `along_mm` farther along it, as where the sensor was measured wrongly."""
    without = spec.encoders and replace(spec.encoders, offsets=(0.0, 0.0))
    right = true_kinematics(replace(spec, encoders=without))
    if exact:
        return right
    generator = np.random.default_rng((spec.seed, 4))
    errors: dict[str, tuple[Array, Array]] = {}  # by parent: the links that it carries share an axis
    links = []
    root, along = right.links[0].name, np.linalg.inv(spec.mount.mechanical_from_sensor())[:3, 2]
    for link in right.links:
        if link.type == FIXED:
            links.append(link)
            continue
        if link.parent not in errors:
            errors[link.parent] = (_direction(generator, link.axis), _direction(generator, link.axis))
        turn, shift = errors[link.parent]
        origin = link.origin.copy()
        origin[:3, 3] += PIVOT_ERROR * shift + (along_mm * along if link.parent == root else 0.0)
        axis = Rotation.from_rotvec(AXIS_ERROR * turn).apply(link.axis)
        links.append(replace(link, origin=origin.round(4), axis=axis))
    return KinematicTree(tuple(links))


def _direction(generator: np.random.Generator, axis: Array) -> Array:
    """A random unit vector [3] across an axis: an error along it would be none."""
    drawn = np.cross(axis, generator.standard_normal(3))
    return drawn / np.linalg.norm(drawn)


def describe_kinematics(spec: SceneSpec) -> dict[str, Any]:
    """truth/kinematics.json."""
    return {
        "instrument": spec.design.name,
        "frame": "tracked sensor (truth), mm",
        "meaning": "value of a joint = sum of gain * reading without its error, plus offset",
        "kinematics": true_kinematics(spec).to_json(),
    }


def _shift(place: Array) -> Array:
    pose = np.eye(4)
    pose[:3, 3] = place
    return pose
