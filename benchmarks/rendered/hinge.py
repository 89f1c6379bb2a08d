"""Where a scene's hinge truly is, in the tracked sensor's frame, and which jaw is the left one."""

from __future__ import annotations

from typing import Any

import numpy as np

from rendered.motion import Array
from rendered.scenes import SceneSpec

JAW_LEFT, JAW_RIGHT = 3, 4


def truth_ids(spec: SceneSpec) -> tuple[int, int]:
    """Part ids of the first and second jaw.

    The hinge axis is given the sign that makes its largest component in the sensor's frame positive; the left jaw
    opens towards (shaft direction x axis).
    """
    return (JAW_LEFT, JAW_RIGHT) if _sign(spec) > 0 else (JAW_RIGHT, JAW_LEFT)


def describe_hinge(spec: SceneSpec) -> dict[str, Any]:
    """truth/hinge.json: hinge and shaft in the true sensor frame (mm), and how the jaws turn (rad per rad)."""
    mechanical_from_sensor = spec.mount.mechanical_from_sensor()
    sensor_from_mechanical = np.linalg.inv(mechanical_from_sensor)
    rotation, shift = sensor_from_mechanical[:3, :3], sensor_from_mechanical[:3, 3]
    sign, (first, _) = _sign(spec), truth_ids(spec)
    # about the axis with its sign, the left jaw turns by minus its share of the opening, the right one by plus
    left, right = spec.design.shares if first == JAW_LEFT else spec.design.shares[::-1]
    return {
        "instrument": spec.design.name,
        "frame": "tracked sensor (truth), mm",
        "hinge_axis": (sign * rotation[:, 0]).tolist(),
        "hinge_pivot": (rotation @ [0, 0, spec.design.hinge] + shift).tolist(),
        "shaft_origin": shift.tolist(),
        "shaft_direction": rotation[:, 2].tolist(),
        "shaft_radius_mm": spec.design.radius,
        "wrist_starts_mm": 0.0,
        "hinge_along_shaft_mm": spec.design.hinge,
        "jaw_lengths_mm": {"jaw_left": _length(spec, JAW_LEFT), "jaw_right": _length(spec, JAW_RIGHT)},
        "turn_per_opening": {"jaw_left": -left, "jaw_right": right},
        "joint": {
            "jaw_angle": {
                "zero": spec.joint.zero,
                "sign": spec.joint.sign,
                "meaning": "reading = zero + sign * opening; opening = angle between the jaws, 0 closed",
            }
        },
        "mechanical_from_sensor": mechanical_from_sensor.tolist(),
    }


def _length(spec: SceneSpec, part: int) -> float:
    return spec.design.jaws[truth_ids(spec).index(part)].length


def _sign(spec: SceneSpec) -> int:
    axis: Array = np.linalg.inv(spec.mount.mechanical_from_sensor())[:3, 0]
    return 1 if axis[np.abs(axis).argmax()] > 0 else -1
