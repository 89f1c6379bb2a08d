"""Calibrations of stereo scopes: both lenses, and where the right camera is seen from the left one."""

from __future__ import annotations

import configparser
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from neeco.capture.documents import printable
from neeco.capture.lens import Lens
from neeco.errors import NeecoError
from neeco.files import read_json, read_text, require_file, visible_entries
from neeco.ingest.lens import checked_lens, first_of, image_size, matrix_numbers, opencv_lens, read_opencv_yaml
from neeco.raster.rotations import rotation_error
from neeco.raster.types import COEFFICIENTS

# names of the left and right camera matrix, and of their distortion
MATRICES = (
    ("M1", "M2"), ("KL", "KR"), ("K0", "K1"), ("K1", "K2"), ("K_left", "K_right"), ("K_l", "K_r"),
    ("cameraMatrix1", "cameraMatrix2"), ("camera_matrix_1", "camera_matrix_2"), ("camera_matrix1", "camera_matrix2"),
    ("camera_matrix_left", "camera_matrix_right"), ("left_camera_matrix", "right_camera_matrix"),
)  # fmt: skip
DISTORTIONS = (
    ("D1", "D2"), ("DL", "DR"), ("D0", "D1"), ("D_left", "D_right"), ("D_l", "D_r"),
    ("distCoeffs1", "distCoeffs2"), ("dist_coeffs_1", "dist_coeffs_2"), ("dist_coeffs1", "dist_coeffs2"),
    ("dist_coeffs_left", "dist_coeffs_right"), ("left_dist_coeffs", "right_dist_coeffs"),
    ("distortion_coefficients_left", "distortion_coefficients_right"),
)  # fmt: skip
EXPECTED = "OpenCV's stereo YAML (M1, D1, M2, D2, R, T), a StereoCalibration.ini, or left.yaml and right.yaml of ROS"
METRES = (5e-4, 0.2)  # how far apart the cameras of a stereo scope or rig are
MILLIMETRES = (1.0, 200.0)
WIDEST_TURN = math.radians(30)  # of one camera against the other
NOT_ROTATED = 1e-3  # of R^T R - I: files round to four decimals


def read_stereo(path: Path) -> tuple[Lens, Lens, np.ndarray]:
    """The left lens, the right lens, and right_from_left [4, 4] mm, which maps points of the left camera's frame to the
    right one's (OpenCV axes).

    Read are OpenCV's stereo YAML (`M1 D1 M2 D2 R T`, or `K1 ...`; R and T may stand in `extrinsics.yml` beside
    `intrinsics.yml`), ROS's camera_info of two cameras (a folder with a left and a right file, or the left file, the
    right one beside it), the da Vinci's `.ini` ([StereoLeft], [StereoRight]) and JSON (`intrinsics`, `extrinsics`, or
    `KL DL KR DR R T`). T is in mm or m: which, its length says, and is refused where both could be. Raises NeecoError
    naming file, field and remedy.
    """
    path = Path(path)
    if path.is_dir():
        return _camera_infos(*_pair_of_files(path))
    require_file(path, EXPECTED)
    if path.suffix.lower() == ".ini":
        return _ini(path)
    document = read_json(path) if path.suffix.lower() == ".json" else read_opencv_yaml(path)
    if not isinstance(document, dict):
        raise NeecoError(f"{path}: holds no keys; expected {EXPECTED}")
    for key in ("data", "camera-calibration"):
        if isinstance(document.get(key), dict):
            document = document[key]
    if "intrinsics" in document and "extrinsics" in document:
        return _two_intrinsics(path, document)
    if _names_in(document, MATRICES) is not None:
        return _matrices(path, document)
    if any(key in document for key in ("projection_matrix", "P", "p")):
        return _camera_infos(path, _right_beside(path))
    raise NeecoError(f"{path}: camera matrices: not there for two cameras; expected {EXPECTED}")


def _matrices(path: Path, document: dict[Any, Any]) -> tuple[Lens, Lens, np.ndarray]:
    """From `M1 D1 M2 D2 R T` and the like."""
    names = _names_in(document, MATRICES)
    assert names is not None
    distortions = _names_in(document, DISTORTIONS)
    if distortions is None:
        raise NeecoError(f"{path}: distortion: not there for two cameras; give D1 and D2, zeros where there is none")
    left, right = [
        _lens(path, _matrix(path, document, matrix), matrix_numbers(path, document[distortion], distortion), document)
        for matrix, distortion in zip(names, distortions, strict=True)
    ]
    source = path
    if "R" not in document and path.stem.lower().startswith("intrinsics"):
        source = path.with_name("ex" + path.name[2:])
        if not source.is_file():
            raise NeecoError(f"{path}: R: missing; put {source.name}, which OpenCV writes with it, beside it")
        document = read_opencv_yaml(source)
    if not isinstance(document, dict) or not {"R", "T"} <= set(document):
        raise NeecoError(f"{source}: R, T: missing; give the right camera's rotation and translation, as OpenCV does")
    return (
        left,
        right,
        _pose(source, matrix_numbers(source, document["R"], "R"), matrix_numbers(source, document["T"], "T")),
    )


def _two_intrinsics(path: Path, document: dict[Any, Any]) -> tuple[Lens, Lens, np.ndarray]:
    """From `intrinsics: [{f, c, k}, {f, c, k}]` and `extrinsics: {om, T}`, as the da Vinci's calibrations have them."""
    cameras, extrinsics = document["intrinsics"], document["extrinsics"]
    if not isinstance(cameras, list) or len(cameras) != 2 or not all(isinstance(camera, dict) for camera in cameras):
        raise NeecoError(f"{path}: intrinsics: expected two cameras, left and right, each with f, c and k; write them")
    if not isinstance(extrinsics, dict):
        raise NeecoError(f"{path}: extrinsics: expected om and T; write them")
    lenses = []
    for number, camera in enumerate(cameras):
        f, c = (matrix_numbers(path, camera.get(key), f"intrinsics[{number}].{key}") for key in ("f", "c"))
        if len(f) != 2 or len(c) != 2:
            raise NeecoError(f"{path}: intrinsics[{number}]: f and c take two numbers each; correct them")
        k = matrix_numbers(path, camera.get("k", []), f"intrinsics[{number}].k")
        lenses.append(_lens(path, (*f, *c), k, document))
    turn = matrix_numbers(path, extrinsics.get("om"), "extrinsics.om")
    return (lenses[0], lenses[1], _pose(path, turn, matrix_numbers(path, extrinsics.get("T"), "extrinsics.T")))


def _ini(path: Path) -> tuple[Lens, Lens, np.ndarray]:
    """From [StereoLeft] and [StereoRight] with res_x, fc_x, cc_x, kc_0 ..., R_0 ... R_8 (by rows) and T_0 ... T_2."""
    parser = configparser.ConfigParser(interpolation=None)
    try:
        parser.read_string(read_text(path, EXPECTED))
    except configparser.Error as error:
        reason = " ".join(str(error).replace("<string>", path.name).split())[:160]
        raise NeecoError(f"{path}: not readable as an .ini file ({reason}); save the calibration again") from None
    cameras: list[dict[str, list[float]]] = []
    lenses = []
    for side in ("StereoLeft", "StereoRight"):
        if not parser.has_section(side):
            raise NeecoError(f"{path}: [{side}]: missing; expected {EXPECTED}")
        values = dict(parser[side])
        found = {
            stem: [values[key] for key in _indexed(stem, values)] for stem in ("fc_", "cc_", "res_", "kc_", "r_", "t_")
        }
        numbers = {stem: [_number(path, f"[{side}] {stem}", text) for text in texts] for stem, texts in found.items()}
        for stem, count in (("fc_", 2), ("cc_", 2)):
            if len(numbers[stem]) != count:
                raise NeecoError(f"{path}: [{side}] {stem}x, {stem}y: missing; save the calibration again")
        size = numbers["res_"] if len(numbers["res_"]) == 2 else [None, None]
        cameras.append(numbers)
        lenses.append(
            _lens(path, (*numbers["fc_"], *numbers["cc_"]), numbers["kc_"], dict(width=size[0], height=size[1]))
        )
    left, right = cameras
    turned = left["r_"] and not np.allclose(left["r_"], np.eye(3).ravel()[: len(left["r_"])], atol=1e-6)
    if turned or any(left["t_"]):
        raise NeecoError(f"{path}: [StereoLeft] R, T: the left camera must be the origin; give the right one's from it")
    return lenses[0], lenses[1], _pose(path, right["r_"], right["t_"])


def _indexed(stem: str, values: dict[str, str]) -> list[str]:
    """The keys `stem` and x, y or 0, 1, 2 ... as far as they go on without a gap."""
    keys = [key for key in (f"{stem}x", f"{stem}y") if key in values]
    while f"{stem}{len(keys)}" in values:
        keys.append(f"{stem}{len(keys)}")
    return keys


def _number(path: Path, field: str, text: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise NeecoError(f"{path}: {field}: {printable(text)} is not a number; save the calibration again") from None


def _camera_infos(left: Path, right: Path) -> tuple[Lens, Lens, np.ndarray]:
    """From two cameras' `camera_matrix`, `distortion_coefficients`, `rectification_matrix` and `projection_matrix`, or
    K, D, R and P, as ROS writes them: the right projection's fourth column is -focal length x baseline."""
    lenses, turns, projections = [], [], []
    for path in (left, right):
        document = read_opencv_yaml(path)
        lenses.append(opencv_lens(path, document))
        turns.append(_numbers(path, document, ("rectification_matrix", "R", "r"), 9).reshape(3, 3))
        projections.append(_numbers(path, document, ("projection_matrix", "P", "p"), 12).reshape(3, 4))
        if rotation_error(turns[-1]) > NOT_ROTATED:
            raise NeecoError(
                f"{path}: rectification_matrix: is no rotation; calibrate the two cameras as one stereo rig"
            )
    focal_x, focal_y = projections[1][0, 0], projections[1][1, 1]
    if min(focal_x, focal_y) <= 0:
        raise NeecoError(f"{right}: projection_matrix: has no focal length; calibrate the cameras as one stereo rig")
    if np.abs(projections[0][:2, 3]).max() > 0:
        raise NeecoError(
            f"{left}: projection_matrix: has a baseline, so it is the right camera's; exchange the two files"
        )
    shift = np.array([projections[1][0, 3] / focal_x, projections[1][1, 3] / focal_y, 0.0])
    if not shift.any():
        raise NeecoError(f"{right}: projection_matrix: has no baseline; calibrate the two cameras as one stereo rig")
    pose = _pose(right, turns[1].T @ turns[0], turns[1].T @ shift)
    return lenses[0], lenses[1], pose


def _pair_of_files(folder: Path) -> tuple[Path, Path]:
    files = [file for file in visible_entries(folder) if file.suffix.lower() in (".yaml", ".yml")]
    left, right = ([file for file in files if side in file.stem.lower()] for side in ("left", "right"))
    if len(left) != 1 or len(right) != 1:
        raise NeecoError(f"{folder}: holds no one left and one right calibration; name the file of one as left.yaml")
    return left[0], right[0]


def _right_beside(path: Path) -> Path:
    for left, right in (("left", "right"), ("Left", "Right"), ("LEFT", "RIGHT")):
        other = path.with_name(path.name.replace(left, right))
        if left in path.name and other.is_file():
            return other
    raise NeecoError(f"{path}: is one camera's; put the right camera's beside it, as left.yaml and right.yaml")


def _names_in(document: dict[Any, Any], pairs: Sequence[tuple[str, str]]) -> tuple[str, str] | None:
    return next((pair for pair in pairs if set(pair) <= set(document)), None)


def _numbers(path: Path, document: dict[Any, Any], names: tuple[str, ...], count: int) -> np.ndarray:
    found = matrix_numbers(path, first_of(document, names), names[0])
    if len(found) != count:
        raise NeecoError(f"{path}: {names[0]}: needs {count} numbers, has {len(found)}; write it as ROS does")
    return np.array(found)


def _matrix(path: Path, document: dict[Any, Any], name: str) -> tuple[float, float, float, float]:
    """Focal lengths and principal point of a 3x3 camera matrix, as it stands there."""
    values = _numbers(path, document, (name,), 9)
    return float(values[0]), float(values[4]), float(values[2]), float(values[5])


def _lens(path: Path, matrix: Sequence[float], distortion: Sequence[float], document: dict[Any, Any]) -> Lens:
    """A lens as OpenCV means its numbers: the first pixel's centre at 0. document: says the images' size."""
    sizes = [
        first_of(document, (side, f"image_{side}", f"image_{side.title()}", f"Camera.{side}"))
        for side in ("width", "height")
    ]
    for name in ("image_size", "imageSize", "size"):
        found = document.get(name)
        if isinstance(found, list) and len(found) == 2:
            sizes = found
    length = next((count for count in COEFFICIENTS if count >= len(distortion)), len(distortion))
    coefficients = [*distortion, *[0.0] * (length - len(distortion))]
    values = [matrix[0], matrix[1], matrix[2] + 0.5, matrix[3] + 0.5]
    return checked_lens(path, values, coefficients, image_size(path, *sizes))


def _pose(path: Path, turn: Sequence[float] | np.ndarray, shift: Sequence[float] | np.ndarray) -> np.ndarray:
    """right_from_left [4, 4] mm of a rotation (9 numbers by rows, or a rotation vector of 3) and a translation."""
    angles, vector = np.asarray(turn, np.float64).ravel(), np.asarray(shift, np.float64).ravel()
    if len(angles) not in (3, 9) or len(vector) != 3:
        raise NeecoError(
            f"{path}: R, T: need 9 (or 3) and 3 numbers, have {len(angles)} and {len(vector)}; correct them"
        )
    if not (np.isfinite(angles).all() and np.isfinite(vector).all()):
        raise NeecoError(f"{path}: R, T: are not all numbers; calibrate again")
    matrix = angles.reshape(3, 3) if len(angles) == 9 else Rotation.from_rotvec(angles).as_matrix()
    if np.abs(matrix).max() > 2 or rotation_error(matrix) > NOT_ROTATED or np.linalg.det(matrix) < 0:
        raise NeecoError(f"{path}: R: is no rotation; write it row by row")
    rotation = Rotation.from_matrix(matrix)
    if rotation.magnitude() > WIDEST_TURN:
        degrees = math.degrees(rotation.magnitude())
        raise NeecoError(f"{path}: R: turns by {degrees:.0f} degrees; the cameras of a stereo scope look the same way")
    distance = float(np.linalg.norm(vector))
    scales = [scale for scale, (least, most) in ((1.0, MILLIMETRES), (1000.0, METRES)) if least <= distance <= most]
    if len(scales) != 1:
        raise NeecoError(f"{path}: T: {distance:.4g} long, which is no stereo scope's in mm or m; give T in mm")
    if vector[0] > np.abs(vector[1:]).max():
        raise NeecoError(
            f"{path}: T: puts the right camera to the left; exchange left and right, or give right_from_left (-R^T T)"
        )
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation.as_matrix(), vector * scales[0]
    return pose
