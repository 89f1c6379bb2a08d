"""Renders a run's instruments with every joint at both ends of its recorded range, to be looked at.

    python benchmarks/joint_ends.py RUN OUT.png [--poses 3]

A row per recorded pose, spread over the recording; a column per combination of ends (two joints: four), at most eight.
Parts are tinted, keypoints joined as in data sets.
"""

from __future__ import annotations

import argparse
import itertools
from dataclasses import replace
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw

import neeco
from neeco.capture.model import Camera, State, evenly_spaced
from neeco.errors import NeecoError
from neeco.evaluation.image_metrics import PART_COLORS
from neeco.synthesis.states import joint_ranges

TINT = 0.35


def ends(state: State, ranges: dict[tuple[str, str], tuple[float, float]]) -> list[State]:
    """The state with every combination of the joints' ends."""
    found = []
    for values in itertools.islice(itertools.product(*ranges.values()), 8):
        moved = dict(state.instruments)
        for (name, joint), value in zip(ranges, values, strict=True):
            moved[name] = replace(moved[name], joints={**moved[name].joints, joint: value})
        found.append(replace(state, instruments=moved))
    return found


def picture(scene: neeco.Scene, state: State, camera: Camera) -> np.ndarray:
    """[H, W, 3] uint8: parts tinted, keypoints joined."""
    drawn = scene.draw(state, camera)
    image, ids = drawn.image.numpy() * 255, drawn.parts.numpy()
    colors = np.concatenate([np.zeros((1, 3)), PART_COLORS])[ids]
    canvas = Image.fromarray(np.where(ids[..., None] > 0, (1 - TINT) * image + TINT * colors, image).astype(np.uint8))
    draw = ImageDraw.Draw(canvas)
    for instrument in drawn.keypoints:  # [K, 3]
        shown = [
            (name, place) for name, place in zip(drawn.keypoint_names, instrument.tolist(), strict=True) if place[2]
        ]
        points = {name: (x, y) for name, (x, y, _) in shown}
        for start, end in scene.learned.skeleton():
            if start in points and end in points:
                draw.line([points[start], points[end]], fill=(255, 255, 255))
        for x, y in points.values():
            draw.ellipse((x - 2, y - 2, x + 2, y + 2), outline=(255, 255, 255))
    return np.asarray(canvas)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("run", type=Path)
    parser.add_argument("output", type=Path)
    parser.add_argument("--poses", type=int, default=3)
    arguments = parser.parse_args()
    scene = neeco.load(arguments.run).scene
    recorded = scene.recorded
    ranges = {key: (found.lower, found.upper) for key, found in joint_ranges([state for state, _ in recorded]).items()}
    rows = []
    for place in evenly_spaced(len(recorded), arguments.poses + 2)[1:-1]:
        state, camera = recorded[place]
        rows.append(np.concatenate([picture(scene, moved, camera) for moved in ends(state, ranges)], 1))
    Image.fromarray(np.concatenate(rows)).save(arguments.output)


if __name__ == "__main__":
    try:
        main()
    except NeecoError as error:
        raise SystemExit(str(error)) from None
