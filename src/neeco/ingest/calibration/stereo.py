"""Calibrations of stereo scopes: both lenses, and the right camera's pose relative to the left one.

Every dialect becomes a document in the keys that `lens.py` knows."""

from __future__ import annotations

import configparser
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import takewhile
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from neeco.base.errors import NeecoError
from neeco.base.files import read_text, require_file, visible_entries
from neeco.capture.documents import printable
from neeco.geometry.camera import COEFFICIENT_COUNTS
from neeco.geometry.lens import Lens
from neeco.geometry.rotations import rigid, rotation_error
from neeco.ingest.calibration.lens import (
    CameraNumbers,
    cameras_in,
    first_of,
    lens_of,
    matrix_numbers,
    read_calibration,
    word,
)

EXPECTED = (
    "OpenCV's stereo YAML (M1, D1, M2, D2, R, T), a camchain of Kalibr, settings of ORB-SLAM, a StereoCalibration.ini, "
    "or left.yaml and right.yaml of ROS"
)
_TURNS, _SHIFTS = ("r", "rotation", "rotationmatrix"), ("t", "translation", "translationvector", "tvec")
_RECTIFICATION, _PROJECTION = ("rectificationmatrix", "r"), ("projectionmatrix", "p")
_RIGHT_FROM_LEFT, _LEFT_FROM_RIGHT = ("tcncnm1",), ("stereotc1c2", "tc1c2")  # 4x4: of Kalibr, of ORB-SLAM


@dataclass(frozen=True, kw_only=True)
class StereoSettings:
    """Limits of a stereo scope or rig."""

    baseline_m: tuple[float, float] = (5e-4, 0.2)  # of a stereo scope or rig
    baseline_mm: tuple[float, float] = (1.0, 200.0)  # the same in mm
    rotation_tolerance: float = 1e-3  # of R^T R - I: files round to four decimals


STEREO = StereoSettings()
MAX_TURN = math.radians(30)  # of one camera relative to the other


def read_stereo(path: Path) -> tuple[Lens, Lens, np.ndarray]:
    """Return the left lens, the right lens, and right_from_left [4, 4] mm, which maps points of the left camera's frame
    to the right one's (OpenCV axes).

    Read are OpenCV's stereo YAML or XML (`M1 D1 M2 D2 R T`, or `K1 ...`; R and T may stand in `extrinsics.yml` next to
    `intrinsics.yml`), Kalibr's camchain, settings of ORB-SLAM (`LEFT.K ...`, `Camera1.fx ...`), ROS's camera_info of
    two cameras (a folder with a left and a right file, or the left file, the right one next to it), the da Vinci's
    `.ini` ([StereoLeft], [StereoRight]) and SCARED's JSON (`KL DL KR DR R T`). T is in mm or m,
    by its length, and is refused where both could be. Raises NeecoError naming file, field and remedy.
    """
    path = Path(path)
    if path.is_dir():
        files = [file for file in visible_entries(path) if file.suffix.lower() in (".yaml", ".yml")]
        left, right = ([file for file in files if side in file.stem.lower()] for side in ("left", "right"))
        if len(left) != 1 or len(right) != 1:
            raise NeecoError(f"{path}: holds no one left and one right calibration; name the file of one as left.yaml")
        return from_projections(_one_camera(left[0]), _one_camera(right[0]))
    require_file(path, EXPECTED)
    document = _of_ini(path) if path.suffix.lower() == ".ini" else read_calibration(path)
    if not isinstance(document, dict):
        raise NeecoError(f"{path}: holds no keys; expected {EXPECTED}")
    if isinstance(document.get("camera-calibration"), dict):
        document = document["camera-calibration"]
    cameras = cameras_in(path, document)
    if len(cameras) == 2:
        return _two_cameras(path, document, *cameras)
    if cameras and first_of(cameras[0].keys, _PROJECTION) is not None:
        for one, other in (("left", "right"), ("Left", "Right"), ("LEFT", "RIGHT")):
            if one in path.name and (beside := path.with_name(path.name.replace(one, other))).is_file():
                return from_projections(RosCamera(path, cameras[0]), _one_camera(beside))
        raise NeecoError(f"{path}: is one camera's; put the right camera's next to it, as left.yaml and right.yaml")
    raise NeecoError(f"{path}: camera matrices: not there for two cameras; expected {EXPECTED}")


@dataclass(frozen=True)
class RosCamera:
    """A camera_info. where: begins messages; camera: with its rectification and projection among its keys; rectified:
    are its images rectified already?"""

    where: Path | str
    camera: CameraNumbers
    rectified: bool = False

    def lens(self) -> Lens:
        """Return the lens of the images, of rectified ones the pinhole of the projection. Raises NeecoError."""
        if not self.rectified:
            return lens_of(self.where, self.camera)
        projection = self.projection()
        pinhole = (projection[0, 0], projection[1, 1], projection[0, 2], projection[1, 2])
        return lens_of(self.where, replace(self.camera, intrinsics=pinhole, distortion=(), fisheye=False))

    def rectification(self) -> np.ndarray:
        """Return rectified_from_camera [3, 3]. Raises NeecoError."""
        value = first_of(self.camera.keys, _RECTIFICATION)
        turn = np.reshape(matrix_numbers(self.where, value, _RECTIFICATION[0], 9), (3, 3))
        if rotation_error(turn) > STEREO.rotation_tolerance:
            problem = "is no rotation; calibrate the two cameras as one stereo rig"
            raise NeecoError(f"{self.where}: rectification_matrix: {problem}")
        return turn

    def projection(self) -> np.ndarray:
        """Return the projection matrix [3, 4]. Raises NeecoError."""
        value = first_of(self.camera.keys, _PROJECTION)
        return np.reshape(matrix_numbers(self.where, value, _PROJECTION[0], 12), (3, 4))


def from_projections(left: RosCamera, right: RosCamera) -> tuple[Lens, Lens, np.ndarray]:
    """Return lenses and pose as `read_stereo` does, from the rectification and projection of two cameras as ROS's
    camera_info and ORB-SLAM's settings have them: the right projection's fourth column is -focal length x baseline.
    Raises NeecoError."""
    of_left, of_right = left.projection(), right.projection()
    focal_x, focal_y = of_right[0, 0], of_right[1, 1]
    if min(focal_x, focal_y) <= 0:
        problem = "has no focal length; calibrate the cameras as one stereo rig"
        raise NeecoError(f"{right.where}: projection_matrix: {problem}")
    if np.abs(of_left[:2, 3]).max() > 0:
        raise NeecoError(
            f"{left.where}: projection_matrix: has a baseline, so it is the right camera's; exchange left and right"
        )
    shift = np.array([of_right[0, 3] / focal_x, of_right[1, 3] / focal_y, 0.0])
    if not shift.any():
        raise NeecoError(
            f"{right.where}: projection_matrix: has no baseline (its 4th number is 0), so the cameras were calibrated "
            "one by one; calibrate them as one stereo rig and give that file as stereo.calibration"
        )
    turns = [np.eye(3) if camera.rectified else camera.rectification() for camera in (left, right)]
    return left.lens(), right.lens(), _pose(right.where, turns[1].T @ turns[0], turns[1].T @ shift)


def _two_cameras(
    path: Path, document: dict[Any, Any], left: CameraNumbers, right: CameraNumbers
) -> tuple[Lens, Lens, np.ndarray]:
    """Return the lenses and the pose that one file states of both cameras."""
    lenses = (_lens(path, left), _lens(path, right))
    keys = {word(str(name)): value for name, value in document.items()}
    of_pair = {**right.keys, **keys}
    for names, turned_back in ((_RIGHT_FROM_LEFT, False), (_LEFT_FROM_RIGHT, True)):
        if (stated := first_of(of_pair, names)) is not None:
            matrix = np.reshape(matrix_numbers(path, stated, names[0], 16), (4, 4))
            matrix = np.linalg.inv(matrix) if turned_back and np.linalg.det(matrix) else matrix
            return *lenses, _pose(path, matrix[:3, :3].ravel(), matrix[:3, 3])
    source, turn, shift = path, first_of(keys, _TURNS), first_of(keys, _SHIFTS)
    if turn is None and first_of(right.keys, _PROJECTION) is not None:
        return from_projections(RosCamera(path, left), RosCamera(path, right))
    if turn is None and path.stem.lower().startswith("intrinsics"):
        source = path.with_name("ex" + path.name[2:])
        if not source.is_file():
            raise NeecoError(f"{path}: R: missing; put {source.name}, which OpenCV writes with it, next to it")
        extrinsics = read_calibration(source)
        keys = {word(str(name)): value for name, value in extrinsics.items()} if isinstance(extrinsics, dict) else {}
        turn, shift = first_of(keys, _TURNS), first_of(keys, _SHIFTS)
    if turn is None or shift is None:
        raise NeecoError(f"{source}: R, T: missing; give the right camera's rotation and translation, as OpenCV does")
    return *lenses, _pose(source, matrix_numbers(source, turn, "R"), matrix_numbers(source, shift, "T"))


def _of_ini(path: Path) -> dict[str, Any]:
    """Return [StereoLeft] and [StereoRight] with res_x, fc_x, cc_x, kc_0 ..., R_0 ... R_8 (by rows) and T_0 ... T_2, in
    the keys of OpenCV."""
    parser = configparser.ConfigParser(interpolation=None)
    try:
        parser.read_string(read_text(path, EXPECTED))
    except configparser.Error as error:
        reason = " ".join(str(error).replace("<string>", path.name).split())[:160]
        raise NeecoError(f"{path}: not readable as an .ini file ({reason}); save the calibration again") from None
    converted: dict[str, Any] = {}
    for section, side in (("StereoLeft", "left"), ("StereoRight", "right")):
        if not parser.has_section(section):
            raise NeecoError(f"{path}: [{section}]: missing; expected {EXPECTED}")
        values, numbers = parser[section], dict[str, list[float]]()
        ranges = {"fc": "xy", "cc": "xy", "res": "xy", "kc": range(8), "r": range(9), "t": range(3)}
        for stem, ends in ranges.items():
            keys = takewhile(values.__contains__, (f"{stem}_{end}" for end in ends))  # up to the first gap
            texts = [values[key] for key in keys]
            try:
                numbers[stem] = [float(text) for text in texts]
            except ValueError:
                problem = f"{printable(', '.join(texts))} are not all numbers; save the calibration again"
                raise NeecoError(f"{path}: [{section}] {stem}_: {problem}") from None
            if stem in ("fc", "cc") and len(numbers[stem]) != 2:
                raise NeecoError(f"{path}: [{section}] {stem}_x, {stem}_y: missing; save the calibration again")
        size = numbers["res"] if len(numbers["res"]) == 2 else [None, None]
        of_camera = (*numbers["fc"], *numbers["cc"], *size, numbers["kc"])
        converted[side] = dict(zip(("fx", "fy", "cx", "cy", "width", "height", "d"), of_camera, strict=True))
        turned = not np.allclose(numbers["r"], np.eye(3).ravel()[: len(numbers["r"])], atol=1e-6)
        if side == "left" and (any(numbers["t"]) or turned):
            problem = "the left camera must be the origin; give the right one's from it"
            raise NeecoError(f"{path}: [StereoLeft] R, T: {problem}")
    return converted | {"R": numbers["r"], "T": numbers["t"]}


def _one_camera(path: Path) -> RosCamera:
    cameras = cameras_in(path, read_calibration(path))
    if not cameras:
        raise NeecoError(f"{path}: camera_matrix: missing; expected the camera_info of one camera, as ROS saves it")
    return RosCamera(path, cameras[0])


def _lens(path: Path, camera: CameraNumbers) -> Lens:
    """Return the lens of a camera, its distortion filled up with zeros to as many coefficients as OpenCV has."""
    length = next((count for count in COEFFICIENT_COUNTS if count >= len(camera.distortion)), len(camera.distortion))
    missing = (0.0,) * (length - len(camera.distortion))
    return lens_of(path, replace(camera, distortion=camera.distortion + missing))


def _pose(path: Path | str, turn: Sequence[float] | np.ndarray, shift: Sequence[float] | np.ndarray) -> np.ndarray:
    """Return right_from_left [4, 4] mm of a rotation (9 numbers by rows, or a rotation vector of 3) and a
    translation."""
    angles, vector = np.asarray(turn, np.float64).ravel(), np.asarray(shift, np.float64).ravel()
    if len(angles) not in (3, 9) or len(vector) != 3:
        problem = f"need 9 (or 3) and 3 numbers, have {len(angles)} and {len(vector)}; correct them"
        raise NeecoError(f"{path}: R, T: {problem}")
    if not (np.isfinite(angles).all() and np.isfinite(vector).all()):
        raise NeecoError(f"{path}: R, T: are not all numbers; calibrate again")
    matrix = angles.reshape(3, 3) if len(angles) == 9 else Rotation.from_rotvec(angles).as_matrix()
    if np.abs(matrix).max() > 2 or rotation_error(matrix) > STEREO.rotation_tolerance or np.linalg.det(matrix) < 0:
        raise NeecoError(f"{path}: R: is no rotation; write it row by row")
    rotation = Rotation.from_matrix(matrix)
    if rotation.magnitude() > MAX_TURN:
        degrees = math.degrees(rotation.magnitude())
        raise NeecoError(f"{path}: R: turns by {degrees:.0f} degrees; the cameras of a stereo scope look the same way")
    distance = float(np.linalg.norm(vector))
    ranges = ((1.0, STEREO.baseline_mm), (1000.0, STEREO.baseline_m))
    scales = [scale for scale, (least, most) in ranges if least <= distance <= most]
    if len(scales) != 1:
        raise NeecoError(f"{path}: T: {distance:.4g} long, which is no stereo scope's in mm or m; give T in mm")
    if vector[0] > np.abs(vector[1:]).max():
        raise NeecoError(
            f"{path}: T: puts the right camera to the left; exchange left and right, or give right_from_left (-R^T T)"
        )
    return rigid(rotation.as_matrix(), vector * scales[0])
