"""Calibrations of one camera or of two, in the keys of OpenCV, ROS, Kalibr, ORB-SLAM and similar tools.

All of them state what OpenCV does: a principal point that counts from the first pixel's centre, and its distortion.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import accumulate
from pathlib import Path
from typing import Any

import cv2

from neeco.base.errors import NeecoError
from neeco.base.files import parse_yaml, read_json, read_text
from neeco.capture.documents import as_float, printable

EXPECTED = "camera_matrix and distortion_coefficients, as OpenCV writes them"
FISHEYE = {"fisheye", "equidistant", "equi", "kannalabrandt", "kannalabrandt8", "opencvfisheye"}
OTHER_MODELS = {"fov", "omni", "mei", "ds", "doublesphere", "eucm", "scaramuzza"}  # that OpenCV's cannot stand for
SIDES = (("left", "right"), ("l", "r"), ("0", "1"), ("1", "2"), ("cam0", "cam1"), ("camera1", "camera2"))
MAX_DEPTH = 60  # of nested brackets, tags or blanks: OpenCV's parser recurses without a limit
MAX_INDENT = 4 * MAX_DEPTH  # blanks

# names without capitals and signs: Camera_Matrix, cameraMatrix and camera_matrix are one
_MATRIX = ("cameramatrix", "intrinsicmatrix", "intrinsicsmatrix", "cammatrix", "cameramat", "mtx", "k", "m")
_DISTORTION: tuple[str, ...] = ("distortioncoefficients", "distortioncoeffs", "distcoeffs", "distcoeff", "distcoefs")
_DISTORTION += ("distortion", "dist", "d")
_INTRINSICS = ("intrinsics", "projectionparameters")  # four numbers, or by name
_FOCAL = (("fx", "fy", "cx", "cy"), ("mu", "mv", "u0", "v0"))
_COEFFICIENTS = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
_FISHEYE_COEFFICIENTS = (("k1", "k2", "k3", "k4"), ("k2", "k3", "k4", "k5"))  # of OpenCV, and with mu, mv, u0, v0
_SIZES = (("imagewidth", "imageheight"), ("width", "height"), ("w", "h"), ("cols", "rows"))
_SIZE_LISTS = ("resolution", "imagesize", "size")  # width, height
_MODELS = ("distortionmodel", "cameramodel", "modeltype", "type", "model")
_SECTIONS = ("camera", "cam", "cam0", "camera1")


@dataclass(frozen=True)
class CameraNumbers:
    """One camera. intrinsics: fx, fy, cx, cy px, the first pixel's centre at 0; distortion: OpenCV's coefficients, of a
    fisheye lens where `fisheye`; size: width and height px, as they stand there; keys: all it says, by plain name."""

    intrinsics: tuple[float, float, float, float]
    distortion: tuple[float, ...]
    size: tuple[Any, Any]
    fisheye: bool
    keys: Mapping[str, Any]


def read_calibration(path: Path) -> Any:
    """Return the document of a calibration file: JSON, YAML, or OpenCV's own dialects of YAML and XML.

    OpenCV's own (`%YAML:1.0`, XML) are read by cv2.FileStorage, others by PyYAML, which reads ROS's files and plain
    lists, and names a bad line. Raises NeecoError.
    """
    if path.suffix.lower() == ".json":
        document = read_json(path)
        return _matrix_alone(json.dumps(document)) or document if isinstance(document, list) else document
    text = read_text(path, "OpenCV's calibration as YAML or XML")
    if text.lstrip().startswith("<"):
        if "<opencv_storage" not in text:
            raise NeecoError(f"{path}: is XML, but not OpenCV's (<opencv_storage>); save the calibration as YAML")
        header = "" if text.lstrip().startswith("<?xml") else '<?xml version="1.0"?>\n'
        parsed = _by_opencv(header + text.lstrip())
        if parsed is None:
            raise NeecoError(f"{path}: is XML that OpenCV cannot read; save the calibration again")
        return parsed
    if isinstance(document := _by_opencv(text), dict):
        return document
    # `%YAML:1.0` is OpenCV's own spelling, which YAML itself does not allow
    lines = ["" if line.startswith("%YAML") else line for line in text.splitlines()]
    begun = next((number for number, line in enumerate(lines) if re.match(r"\s*[^\s#-]", line)), 0)
    if "---" in lines[begun:]:  # as `rostopic echo` ends each message
        lines = lines[: lines.index("---", begun)]
    document = parse_yaml(path, "\n".join(lines), "save the calibration again")
    return document if isinstance(document, dict) else _matrix_alone(text) or document


def _matrix_alone(text: str) -> dict[str, list[float]] | None:
    """Return the camera of a text of nothing but a matrix: nine numbers by rows, of which the last are 0 0 1."""
    try:
        numbers = [float(part) for part in re.split(r"[\s,;\[\]]+", text.strip("[]; \t\r\n"))]
    except ValueError:
        return None
    return {"camera_matrix": numbers} if len(numbers) == 9 and numbers[6:] == [0, 0, 1] else None


def cameras_in(where: Path | str, document: Any) -> tuple[CameraNumbers, ...]:
    """Return the camera of a document, or the left one and the right one; () where it has none. `where`
    begins messages. Raises NeecoError for numbers that cannot be."""
    if not isinstance(document, dict):
        return ()
    keys = _plain(document)
    if {"a0", "a2"} <= keys.keys():
        raise _unread_model(where, "a0, a2: omnidirectional (Scaramuzza)")
    for pair in SIDES:
        sides = [_side(keys, side) for side in pair]
        if all(_has_camera(side) for side in sides):
            left, right = (_camera(where, side, pair_of=True) for side in sides)
            return left, right
    for section in ("", *_SECTIONS):
        inner = keys if not section else _side(keys, section)
        if _has_camera(inner):
            return (_camera(where, inner),)
    return ()


def _unread_model(where: Path | str, what: str) -> NeecoError:
    remedy = "undistort the images first, or calibrate radial and tangential (radtan), or equidistant, distortion"
    return NeecoError(f"{where}: {what}: this lens model is not supported; {remedy}")


def first_of(document: Mapping[Any, Any], names: Sequence[str]) -> Any:
    """Return the value of the first of these names; None where there is none."""
    return next((document[name] for name in names if document.get(name) is not None), None)


def word(name: str) -> str:
    """A name in small letters and digits alone."""
    return re.sub(r"[^a-z0-9]", "", name.lower())


def matrix_numbers(where: Path | str, value: Any, field: str, count: int | None = None) -> list[float]:
    """The `count` numbers of a matrix in row order, from OpenCV's or ROS's {rows, cols, data} or from (nested)
    lists."""
    if isinstance(value, dict):
        value = value.get("data")
    if value is None:
        raise NeecoError(f"{where}: {field}: missing; expected it as OpenCV writes it")
    if not isinstance(value, list):
        raise NeecoError(f"{where}: {field}: expected numbers, found {printable(value)}; write it as OpenCV does")
    flat: list[float] = []
    for item in value:
        for entry in item if isinstance(item, list) else [item]:
            number = as_float(entry)
            if number is None:
                problem = f"{printable(entry)} is not a usable number; write it as OpenCV does"
                raise NeecoError(f"{where}: {field}: {problem}")
            flat.append(number)
    if count not in (None, len(flat)):
        raise NeecoError(f"{where}: {field}: needs {count} numbers, has {len(flat)}; write it as OpenCV does")
    return flat


def _by_opencv(text: str) -> Any:
    """Return the document that cv2.FileStorage reads from a text; None where it is none of its own."""
    depths = accumulate(1 if token in "[{<" else -1 for token in re.findall(r"[\[{]|[\]}]|<(?![/?!])|</", text))
    indent = max((len(line) - len(line.lstrip()) for line in text.splitlines()), default=0)
    if max(depths, default=0) > MAX_DEPTH or indent > MAX_INDENT or not text.startswith(("%YAML", "<?xml")):
        return None
    try:
        storage = cv2.FileStorage(text, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
    except (cv2.error, SystemError):
        return None
    try:
        return _value(storage.root()) if storage.isOpened() else None
    except ValueError:  # parse_yaml names the line
        return None
    finally:
        storage.release()


def _value(node: Any) -> Any:
    if node.isMap():
        names = node.keys()
        if len(set(names)) < len(names):
            raise ValueError("a key stands there twice")
        return {name: _value(node.getNode(name)) for name in names}
    if node.isSeq():
        return [_value(node.at(index)) for index in range(node.size())]
    if node.isString():
        return node.string()
    return int(node.real()) if node.isInt() else node.real() if node.isReal() else None


def _plain(document: Mapping[Any, Any]) -> dict[str, Any]:
    """Return the document by names of small letters and digits."""
    return {word(str(name)): value for name, value in document.items()}


def _side(keys: Mapping[str, Any], side: str) -> dict[str, Any]:
    """Return the keys of one camera: in a section of its own, or those that begin or end with its name; the images'
    size and model may be stated for both."""
    section = keys.get(side)
    if isinstance(section, dict) and "data" not in section:
        return _plain(section)
    shared = [name for names in (*_SIZES, _SIZE_LISTS, _MODELS) for name in names]
    fields = {name: keys[f"camera{name}"] for name in shared if f"camera{name}" in keys}  # Camera.width, Camera1.fx
    fields |= {name: keys[name] for name in shared if name in keys}
    fields |= {name.removesuffix(side): value for name, value in keys.items() if name.endswith(side) and name != side}
    return fields | {
        name.removeprefix(side): value for name, value in keys.items() if name.startswith(side) and name != side
    }


def _has_camera(keys: Mapping[str, Any]) -> bool:
    matrix = first_of(keys, _MATRIX)
    if isinstance(matrix, dict | list):
        return True
    listed = first_of(keys, _INTRINSICS)
    if isinstance(listed, list):  # with more than that: `intrinsics` of a recording.yaml count from the image's corner
        return len(listed) == 4 and first_of(keys, (*_MODELS, *_DISTORTION, *_SIZE_LISTS)) is not None
    named = _plain(listed) if isinstance(listed, dict) else keys
    return any(set(names) <= set(named) for names in _FOCAL)


def _camera(where: Path | str, keys: Mapping[str, Any], pair_of: bool = False) -> CameraNumbers:
    """Return the camera of keys that have one. Raises NeecoError."""
    models = {word(str(keys[name])) for name in _MODELS if name in keys}
    if unread := models & OTHER_MODELS:
        raise _unread_model(where, min(unread))
    matrix, listed = first_of(keys, _MATRIX), first_of(keys, _INTRINSICS)
    if isinstance(matrix, dict | list):
        values = matrix_numbers(where, matrix, "camera_matrix", 9)
        if values[2] == values[5] == 0 and all(values[6:8]):
            raise NeecoError(f"{where}: camera_matrix: stands column by column; write it row by row, as OpenCV does")
        four = [values[0], values[4], values[2], values[5]]
    elif isinstance(listed, list):
        four = matrix_numbers(where, listed, "intrinsics")
    else:
        intrinsics = _plain(listed) if isinstance(listed, dict) else keys
        focal = next(names for names in _FOCAL if set(names) <= set(intrinsics))
        four = matrix_numbers(where, [intrinsics[name] for name in focal], ", ".join(focal))
    size = next(((keys[w], keys[h]) for w, h in _SIZES if w in keys and h in keys), (None, None))
    both = first_of(keys, _SIZE_LISTS)
    if isinstance(both, list) and len(both) == 2:
        size = (both[0], both[1])
    fisheye = bool(models & FISHEYE)
    bends = list[float]()
    vector = first_of(keys, _DISTORTION)
    named = dict(keys)
    for section in (keys.get("projectionparameters"), keys.get("distortionparameters")):
        named |= _plain(section) if isinstance(section, dict) else {}
    names: tuple[str, ...] = _COEFFICIENTS if not fisheye else _FISHEYE_COEFFICIENTS["mu" in named]
    present = [index for index, name in enumerate(names) if named.get(name) is not None]
    if vector is not None:
        bends = matrix_numbers(where, vector, "distortion_coefficients")
    elif present:  # by name, among all keys or in a section of their own
        names = names[: next(length for length in (4, 5, 8) if length > present[-1])]
        bends = matrix_numbers(where, [named.get(name) or 0.0 for name in names], ", ".join(names))
    if pair_of and matrix is not None and not bends and vector is None:
        raise NeecoError(f"{where}: distortion: not there for two cameras; give D1 and D2, zeros where there is none")
    return CameraNumbers((four[0], four[1], four[2], four[3]), tuple(bends), size, fisheye, keys)
