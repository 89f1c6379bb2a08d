"""What transforms.json says of an instrument found in the images: its shaft, and how sure each state is."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import asdict
from typing import Any

from neeco.capture.documents import Node
from neeco.capture.model import FromVideo, Uncertainty

UNKNOWN_DEG = 180.0  # the standard deviation of an angle of which nothing is known


def parse_from_video(node: Node) -> FromVideo | None:
    """`{"shaft_diameter_mm", "working_length_mm"}`; None, and reported, where it is not that."""
    if not node.is_object():
        return None
    diameter = node.child("shaft_diameter_mm").number(above=0)
    working = node.child("working_length_mm").number(least=0)
    return None if diameter is None or working is None else FromVideo(diameter, working)


def parse_uncertainty(node: Node, joints: Iterable[str]) -> Uncertainty | None:
    """`{"translation_mm": [x, y, z], "rotation_deg": [x, y, z], "joints_deg": {name: sd}}`, of a state with `joints`;
    None, and reported, where it is not that."""
    if not node.is_object():
        return None
    translation = _deviations(node.child("translation_mm"), "in the camera's axes, mm")
    rotation = _deviations(node.child("rotation_deg"), "about the instrument's x, y, z, degrees")
    named: dict[str, float] = {}
    good = translation is not None and rotation is not None
    if node.has("joints_deg"):
        given = node.child("joints_deg")
        good &= given.is_object()
        for name in given.value if isinstance(given.value, dict) else ():
            deviation = given.child(name).number(least=0)
            if name not in joints:
                given.child(name).error("the state has no such joint", "leave it out")
                good = False
            elif deviation is None:
                good = False
            else:
                named[name] = deviation
    if not good or translation is None or rotation is None:
        return None
    return Uncertainty(translation, rotation, named)


def from_video_to_json(seen: FromVideo) -> dict[str, float]:
    """As `parse_from_video` takes it."""
    return asdict(seen)


def uncertainty_to_json(uncertainty: Uncertainty) -> dict[str, Any]:
    """As `parse_uncertainty` takes it."""
    written: dict[str, Any] = {
        "translation_mm": [float(value) for value in uncertainty.translation_mm],
        "rotation_deg": [float(value) for value in uncertainty.rotation_deg],
    }
    joints = {name: float(value) for name, value in sorted(uncertainty.joints_deg.items())}
    return written | ({"joints_deg": joints} if joints else {})


def _deviations(node: Node, what: str) -> tuple[float, float, float] | None:
    found = node.numbers(3, f"standard deviations {what}")
    if found is None:
        return None
    if min(found) < 0:
        node.error(f"{min(found):g} is no standard deviation", "give numbers of 0 or more")
        return None
    return found[0], found[1], found[2]
