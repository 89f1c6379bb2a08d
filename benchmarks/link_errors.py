"""Compares the links that a run learned with those of a rendered capture's truth, and with those that were stated.

    python benchmarks/link_errors.py RUN CAPTURE

Prints for every joint how far its axis (degrees) and its pivot (mm, across the axis) are off, at the middle of the
recorded readings: there an encoder's offset counts where it carries an axis along, and nowhere else. Then the offsets
and gains that were learned of the readings.
"""

from __future__ import annotations

import argparse
import json
import math
from pathlib import Path

import torch
from torch import Tensor

import neeco
from neeco.capture.readers import kinematics_of
from neeco.errors import NeecoError
from neeco.methods.kinematic.stated_links import StatedLinks


def standing(links: StatedLinks, readings: dict[str, float]) -> list[tuple[Tensor, Tensor]]:
    """(pivot [3] mm, unit axis [3]) of every joint as it stands at these readings, instrument frame."""
    found = []
    for group, pivot, axis in zip(links.joint_groups, *links.axes(), strict=True):
        carrier = links.link_of(group[0].parent)
        ends = links.place(torch.stack([pivot, pivot + axis]), carrier, readings)
        found.append((ends[0], ends[1] - ends[0]))
    return found


def apart(one: tuple[Tensor, Tensor], other: tuple[Tensor, Tensor]) -> tuple[float, float]:
    """Degrees between two axes, and mm between their pivots, across the other's axis."""
    angle = math.degrees(math.acos(min(1.0, abs(float(one[1] @ other[1])))))
    between = one[0] - other[0]
    return angle, float((between - (between @ other[1]) * other[1]).norm())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("run", type=Path)
    parser.add_argument("capture", type=Path)
    given = parser.parse_args()
    scene = neeco.load(given.run).scene
    instrument = scene.instruments[0]
    file = given.capture / "truth" / "kinematics.json"
    truth = StatedLinks(kinematics_of(json.loads(file.read_text())["kinematics"], str(file)))
    learned = scene.learned.deformation.articulations[0]
    stated = StatedLinks(instrument.kinematics)
    names = learned.reading_names
    recorded = [state.instruments[instrument.name].joints for state, _ in scene.recorded]
    middle = {name: sum(joints[name] for joints in recorded) / len(recorded) for name in names}
    with torch.no_grad():
        true = standing(truth, middle)
        for words, links in (("stated", stated), ("learned", learned)):
            for group, here, there in zip(links.joint_groups, standing(links, middle), true, strict=True):
                angle, shift = apart(here, there)
                print(f"{words:8} {group[0].name:12} {angle:6.2f} deg {shift:6.2f} mm")
        for name, offset, gain in zip(names, learned.reading_offsets, learned.reading_gains, strict=True):
            print(f"reading  {name:12} offset {float(offset):8.4f}, gain {1 + float(gain):.4f}")


if __name__ == "__main__":
    try:
        main()
    except NeecoError as error:
        raise SystemExit(str(error)) from None
