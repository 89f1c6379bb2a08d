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
