"""Read Blender / D-NeRF captures: transforms_{train,val,test}.json with `camera_angle_x`."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from neeco.capture.images import EXTENSIONS
from neeco.capture.nodes import Node
from neeco.capture.parsed import Parsed, Place
from neeco.capture.points import random_points
from neeco.capture.transforms import parse_frames, parse_points

HALF_SIZE = 1.5  # the synthetic scenes fit in this cube; 3DGS starts from random points there


def is_blender(document: Node) -> bool:
    """Whether a transforms file gives the field of view instead of intrinsics, as Blender's exporters do."""
    value = document.value
    return "camera_angle_x" in value and "fl_x" not in value and "instruments" not in value


def parse_blender(files: dict[Path, Node], root: Path, background: float = 1.0) -> Parsed:
    """Read the files of a Blender capture, given with their content, one split each, named by the file.

    Transparent pixels show `background`. Without a point cloud, seeded random ones in a cube are used. Where no frame
    at all has a time nothing moves (NeRF's synthetic scenes): every frame then has time 0.
    """
    parsed = Parsed(root)
    moves = False
    for file, document in files.items():
        moves = moves or _has_times(document)
        _, _, split = file.stem.rpartition("_")
        split_name = split if split in ("train", "val", "test") else None
        parse_frames(document, file.parent, parsed, background=background, split=split_name, extensions=EXTENSIONS)
        if parsed.points is None:
            parse_points(document, file.parent, parsed)
    if not moves:
        parsed.frames = [replace(frame, state=replace(frame.state, time=0.0)) for frame in parsed.frames]
        parsed.timed = True
    if parsed.points is None:
        parsed.points = random_points(np.zeros(3), HALF_SIZE)
        parsed.points_place = Place(next(iter(files.values())).file, "ply_file_path")
    return parsed


def _has_times(document: Node) -> bool:
    """Whether any frame of the file says when it was taken."""
    frames = document.value.get("frames")
    return isinstance(frames, list) and any(isinstance(frame, dict) and "time" in frame for frame in frames)
