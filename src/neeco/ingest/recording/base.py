"""A robot base's pose as a recording states it: to a still camera, or to the scope's tracker (`camera_from_base`,
`world_from_base`)."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import numpy as np
from scipy.spatial.transform import Rotation

from neeco.base.errors import NeecoError
from neeco.base.files import parse_yaml, read_text
from neeco.base.settings import Fault, faults_in, join_places, printable, read
from neeco.capture.documents import Node
from neeco.geometry.conventions import DVRK_ECM
from neeco.geometry.rotations import rigid
from neeco.ingest.readers.names import CAMERA, CAMERA_FRAMES, meaning_of
from neeco.ingest.readers.sections import Positive, existing_file, word

BASE_KEY, WORLD_KEY = "camera_from_base", "world_from_base"  # to a still camera; to the laparoscope's tracker
UNKNOWN = "unknown"
DVRK_SD_MM, DVRK_SD_DEG = 8.0, 5.0  # accuracy of the dVRK's registration by a marker, by its own README: 5 to 10 mm
MM = 1000.0  # per m
STATED = f"{{transform: 4 rows, mm, sd_mm: {DVRK_SD_MM:g}, sd_deg: {DVRK_SD_DEG:g}}}"
NEAR_MM = 10.0  # minimum distance of a base from a camera: a smaller one is in metres
WHAT = "a camera registration of the dVRK: JSON"


@dataclass(frozen=True, eq=False)
class StatedBase:
    """The pose of a base: camera_from_base [4, 4] mm, OpenCV axes, or, where `to_world`, the same to the frame of the
    laparoscope's poses (None: unknown); and its standard deviations: mm at the instrument and degrees (None: exact)."""

    matrix: np.ndarray | None = None
    sd_mm: float | None = None
    sd_deg: float | None = None
    to_world: bool = False

    @property
    def key(self) -> str:
        """The key of recording.yaml that states it."""
        return WORLD_KEY if self.to_world else BASE_KEY

    @property
    def exact(self) -> bool:
        return self.matrix is not None and self.sd_mm is None


@dataclass(frozen=True, kw_only=True, eq=False)
class BaseSection:
    """{transform, axes, sd_mm, sd_deg}; axes: those of the camera that the transform leads to."""

    transform: Annotated[np.ndarray | None, Node.rigid] = None
    axes: Annotated[str, word(*CAMERA_FRAMES)] = CAMERA
    sd_mm: Positive | None = None
    sd_deg: Positive | None = None

    def __post_init__(self) -> None:
        if self.transform is None:
            raise Fault("transform", "is missing; give 4 rows of 4 numbers, mm")
        if (self.sd_mm is None) != (self.sd_deg is None):
            missing = "sd_mm" if self.sd_mm is None else "sd_deg"
            raise Fault(missing, "is missing; give both, or none where the transform is exact")


def _of_hand_eye(path: Path) -> StatedBase:
    """Read the YAML that easy_handeye saves, in metres: of a still camera (eye_on_hand: false), base_from_camera.
    Raises NeecoError."""
    remedy = f"give the YAML of easy_handeye, or write {STATED}"
    node = Node(parse_yaml(path, read_text(path, WHAT), remedy), str(path))
    node.members()
    parameters, second = node.child("parameters"), node.has("transform")  # of easy_handeye2
    stated = node.child("transform" if second else "transformation")
    if not isinstance(stated.value, dict):
        stated.fail("is missing", remedy)
    if second:
        still = parameters.child("calibration_type").value == "eye_on_base"
        places = [stated.child("translation").child(axis) for axis in "xyz"]
        places += [stated.child("rotation").child(axis) for axis in "xyzw"]
    else:
        still = (parameters if parameters.value is not None else node).child("eye_on_hand").value is False
        places = [stated.child(name) for name in ("x", "y", "z", "qx", "qy", "qz", "qw")]
    if not still:
        node.fail(
            "does not say `eye_on_hand: false` (`calibration_type: eye_on_base`), so the camera may be on the robot",
            f"calibrate a camera that stands still, or write {STATED}",
        )
    camera = parameters.child("tracking_base_frame") if parameters.has("tracking_base_frame") else None
    axes = CAMERA if camera is None else meaning_of(str(camera.value)).frame or ""
    if camera is not None and axes not in CAMERA_FRAMES:
        camera.fail(f"is {printable(camera.value)}, and nothing says in which axes", f"write {STATED[:-1]}, axes: …}}")
    numbers = np.array([place.number() for place in places])
    if not 0.99 < np.linalg.norm(numbers[3:]) < 1.01:
        stated.fail("qx, qy, qz, qw are no unit quaternion", "calibrate again")
    rotation = Rotation.from_quat(numbers[3:]).as_matrix()
    camera_from_base = rigid(rotation.T, -rotation.T @ numbers[:3] * MM)
    return StatedBase(CAMERA_FRAMES[axes].poses_to_opencv(camera_from_base), DVRK_SD_MM, DVRK_SD_DEG)


def read_dvrk_registration(path: Path) -> StatedBase:
    """Read the file that `camera_registration.py` of jhu-dvrk/dvrk_camera_registration writes for a still camera, in
    metres. Raises NeecoError for another file.

    It is `…-registration-open-cv.json` or, in the dVRK's axes, `…-registration-dVRK.json`: a piece of a system.json
    and no JSON by itself.
    """
    with faults_in(path):
        return _of_hand_eye(path) if path.suffix.lower() in (".yaml", ".yml") else _of_registration(path)


def _of_registration(path: Path) -> StatedBase:
    content = read_text(path, WHAT).strip()
    whole = content.startswith("{")
    try:
        document = json.loads(content if whole else "{" + content.rstrip(",") + "}")
    except (ValueError, RecursionError) as error:
        remedy = "give the file …-registration-open-cv.json, or easy_handeye's YAML"
        raise NeecoError(f"{path}: is not {WHAT}; {remedy}") from error
    node = Node(document, str(path))
    if isinstance(document, dict) and (key := next((key for key in ("matrix", "transform") if key in document), None)):
        transform = node.child(key)
        usual = {"sd_mm": DVRK_SD_MM, "sd_deg": DVRK_SD_DEG, "transform": document.pop(key)}
        return _stated(Node(usual | document, str(path)), transform)
    frame = node.child("base-frame")
    if not isinstance(frame.value, dict):
        frame.fail("is missing", f"give {WHAT}, as …-registration-open-cv.json has it, or write {STATED} instead")
    matrix = frame.child("transform").rigid()
    matrix[:3, 3] *= MM
    name, reference = path.stem.lower(), str(frame.value.get("reference-frame", ""))
    turned = not whole or name.endswith("-dvrk")
    if not turned and "open-cv" not in name and meaning_of(reference).frame == DVRK_ECM.name:
        frame.child("reference-frame").fail(
            f"is {printable(reference)}, and nothing says whether in the dVRK's axes ({DVRK_ECM.words}) or OpenCV's",
            "call the file …-registration-dVRK.json or …-registration-open-cv.json",
        )
    return StatedBase(DVRK_ECM.poses_to_opencv(matrix) if turned else matrix, DVRK_SD_MM, DVRK_SD_DEG)


def parse_base(node: Node) -> StatedBase:
    """Return the base of `camera_from_base`: `unknown`, a file of the dVRK's registration, easy_handeye's or
    the keys of a BaseSection, or such keys."""
    if node.value == UNKNOWN:
        return StatedBase()
    if isinstance(node.value, str):
        return read_dvrk_registration(existing_file(node))
    if not isinstance(node.value, dict):
        raise Fault(node.field, f"expected `unknown`, a file or {STATED}, found {printable(node.value)}")
    return _stated(node, node.child("transform"))


def _stated(node: Node, transform: Node) -> StatedBase:
    stated: BaseSection = read(BaseSection, node)
    assert stated.transform is not None
    if 0 < np.abs(stated.transform[:3, 3]).max() < NEAR_MM:
        transform.fail(f"is within {NEAR_MM:g} mm of the origin: in metres?", "give it in mm")
    return StatedBase(CAMERA_FRAMES[stated.axes].poses_to_opencv(stated.transform), stated.sd_mm, stated.sd_deg)


def parse_world_base(node: Node) -> StatedBase:
    """Return the base of `world_from_base`, which has no axes of a camera."""
    if node.has("axes"):
        raise Fault(join_places(node.field, "axes"), "a tracker's frame has none of a camera's; leave it out")
    return replace(parse_base(node), to_world=True)
