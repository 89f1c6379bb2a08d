"""What a recording says of where an instrument's base stands: to a still camera, or to the scope's tracker
(`camera_from_base`, `world_from_base`)."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from neeco.capture.documents import Node, RaisingReport, printable
from neeco.errors import NeecoError
from neeco.files import read_text
from neeco.geometry.conventions import DVRK_ECM
from neeco.ingest.readers.columns import CAMERA
from neeco.ingest.readers.frame_names import CAMERA_FRAMES, meaning_of

UNKNOWN = "unknown"
DVRK_SD_MM, DVRK_SD_DEG = 8.0, 5.0  # what the dVRK's registration by a marker reaches, by its own README: 5 to 10 mm
MM = 1000.0  # per m
WHAT = "a camera registration of the dVRK: JSON"


@dataclass(frozen=True, eq=False)
class StatedBase:
    """Where a base stands: camera_from_base [4, 4] mm, OpenCV axes, or, where it is `to_world`, the same to the frame
    of the laparoscope's poses (None: unknown); and its standard deviations: mm at the instrument and degrees (None:
    exact)."""

    matrix: np.ndarray | None = None
    sd_mm: float | None = None
    sd_deg: float | None = None
    to_world: bool = False

    @property
    def exact(self) -> bool:
        return self.matrix is not None and self.sd_mm is None


def same_base(one: StatedBase | None, other: StatedBase | None) -> bool:
    """Whether two recordings say the same of a base."""
    if one is None or other is None:
        return one is other
    mine, theirs = one.matrix, other.matrix
    alike = mine is theirs if mine is None or theirs is None else np.array_equal(mine, theirs)
    return alike and (one.sd_mm, one.sd_deg, one.to_world) == (other.sd_mm, other.sd_deg, other.to_world)


def read_dvrk_registration(path: Path) -> StatedBase:
    """The file that `camera_registration.py` of jhu-dvrk/dvrk_camera_registration writes for a camera that stands
    still: `…-registration-open-cv.json`, or, in the dVRK's axes, `…-registration-dVRK.json`, which is no JSON by
    itself but a piece of a system.json. Metres. Raises NeecoError for another file."""
    text = read_text(path, WHAT).strip()
    whole = text.startswith("{")
    try:
        document = json.loads(text if whole else "{" + text.rstrip(",") + "}")
    except (ValueError, RecursionError) as error:
        raise NeecoError(f"{path}: is not {WHAT}; give the file …-registration-open-cv.json") from error
    node = Node(document, str(path), "", RaisingReport())
    if isinstance(document, dict) and "measured_cp" in document:
        node.child("measured_cp").error(
            "states the arm in the base of the arm that holds the scope, not in the camera's frame",
            "give the file …-registration-open-cv.json",
        )
    frame = node.child("base-frame")
    if not isinstance(frame.value, dict):
        frame.error("is missing", f"give {WHAT}, as …-registration-open-cv.json has it")
    matrix = frame.child("transform").rigid()
    assert matrix is not None
    matrix = matrix.copy()
    matrix[:3, 3] *= MM
    name, reference = path.stem.lower(), str(frame.value.get("reference-frame", ""))
    turned = not whole or name.endswith("-dvrk")
    if not turned and "open-cv" not in name and meaning_of(reference).frame == DVRK_ECM.name:
        frame.child("reference-frame").error(
            f"is {printable(reference)}, and nothing says whether in the dVRK's axes ({DVRK_ECM.words}) or OpenCV's",
            "call the file …-registration-dVRK.json or …-registration-open-cv.json",
        )
    return StatedBase(DVRK_ECM.poses_to_opencv(matrix) if turned else matrix, DVRK_SD_MM, DVRK_SD_DEG)


def parse_base(node: Node, folder: Path) -> StatedBase:
    """`unknown`, a registration of the dVRK (a file's name, relative to `folder`), or {transform, axes, sd_mm, sd_deg},
    axes: those of the camera that the transform leads to."""
    value: Any = node.value
    if value == UNKNOWN:
        return StatedBase()
    if isinstance(value, str):
        path = folder / value
        if not path.is_file():
            node.error(f"no such file: {printable(value)}", "write `unknown`, a registration file or {transform: …}")
        return read_dvrk_registration(path)
    if not isinstance(value, dict):
        node.error(f"expected `unknown`, a file or {{transform: …}}, found {printable(value)}")
    for key in value:
        if key not in ("transform", "axes", "sd_mm", "sd_deg"):
            node.child(str(key)).error("unknown key", "the keys here are transform, axes, sd_mm and sd_deg")
    if not node.has("transform"):
        node.child("transform").error("is missing", "give 4 rows of 4 numbers, mm")
    matrix = node.child("transform").rigid()
    axes = value.get("axes", CAMERA)
    if not isinstance(axes, str) or axes not in CAMERA_FRAMES:
        node.child("axes").error(f"{printable(axes)} is no convention", f"write one of {', '.join(CAMERA_FRAMES)}")
    assert matrix is not None
    matrix = CAMERA_FRAMES[axes].poses_to_opencv(matrix)
    sd_mm, sd_deg = (node.child(key).number(above=0.0) if node.has(key) else None for key in ("sd_mm", "sd_deg"))
    if (sd_mm is None) != (sd_deg is None):
        missing = "sd_mm" if sd_mm is None else "sd_deg"
        node.child(missing).error("is missing", "give both, or none where the transform is exact")
    return StatedBase(matrix, sd_mm, sd_deg)
