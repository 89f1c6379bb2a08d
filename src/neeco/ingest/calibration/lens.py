"""The optics of the images: the lens of a calibration file, and the round field of view.

Calibrations of one camera or of two are read in the keys of OpenCV, ROS, Kalibr, ORB-SLAM and similar tools. All of
them state what OpenCV does: a principal point that counts from the first pixel's centre, and its distortion.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import accumulate, islice
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from scipy import ndimage
from scipy.optimize import least_squares

from neeco.base.errors import NeecoError
from neeco.base.files import parse_yaml, read_json, read_text, require_file
from neeco.base.plausible import size_fault
from neeco.base.settings import faults_in
from neeco.capture.documents import Node, as_float, printable
from neeco.capture.readers.cameras import opencv_distortion, stated_distortion
from neeco.geometry.camera import COEFFICIENT_COUNTS
from neeco.geometry.lens import Border, Lens

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
FISHEYE_DISTORTION = ("k1", "k2", "k3", "k4")
FISHEYE_MODEL = "OPENCV_FISHEYE"
MAX_NUMBER = 1e9  # of any of a lens's numbers


@dataclass(frozen=True, kw_only=True)
class BorderSettings:
    """Thresholds of the dark border around a round field of view."""

    max_frames: int = 48  # used
    max_black: float = 40.0  # of 255; a border brighter than this in most frames is no border
    edge_margin: float = 0.015  # of the radius, left out: the border's edge is blurred
    max_misfit: float = 0.015  # of the radius: distance of the edge from a circle
    min_clean: float = 0.9  # share of the pixels outside the circle that must be dark, of those inside that must not be
    min_edge_drop: float = 0.6  # share of the brightness inside the edge that must be gone right outside


BORDERS = BorderSettings()


def read_lens(source: Path | Sequence[float] | None) -> Lens | None:
    """Return a lens from a calibration in OpenCV's names (YAML, XML, JSON; of two cameras, the left one's), the fields
    of a nerfstudio JSON, or (fl_x, fl_y, cx, cy) px.

    None: to be estimated. OpenCV's principal point counts from the first pixel's centre, ours from its corner: half a
    pixel is added. A fisheye lens becomes one of OpenCV's rational model. Raises NeecoError naming file, field and
    remedy.
    """
    if source is None:
        return None
    if not isinstance(source, Path):
        return checked_lens("intrinsics", [*source], (), None)
    require_file(source, "a calibration as YAML, XML or JSON")
    document = read_calibration(source)
    cameras = () if isinstance(document, dict) and "fl_x" in document else cameras_in(source, document)
    if cameras:
        return lens_of(source, cameras[0])
    if source.suffix.lower() != ".json":
        problem = "camera_matrix: missing" if isinstance(document, dict) else "no keys"
        raise NeecoError(f"{source}: {problem}; expected {EXPECTED}")
    if not isinstance(document, dict):
        raise NeecoError(f"{source}: expected an object with fl_x, fl_y, cx, cy")
    size = image_size(source, document.get("w"), document.get("h"))
    if missing := [key for key in ("fl_x", "cx", "cy") if key not in document]:
        raise NeecoError(f"{source}: {missing[0]}: missing; give fl_x, fl_y, cx, cy (and k1, k2, p1, p2 if distorted)")
    values = [document["fl_x"], document.get("fl_y", document["fl_x"]), document["cx"], document["cy"]]
    with faults_in(source):
        stated = stated_distortion(Node(document, str(source)).child)
    lens = checked_lens(source, values, (), size)
    try:
        return replace(lens, distortion=opencv_distortion(stated.model, stated.coefficients, lens.intrinsics, size))
    except NeecoError as error:
        raise NeecoError(f"{source}: distortion: {error}") from None


def lens_of(where: Path | str, camera: CameraNumbers) -> Lens:
    """The lens of one camera of a calibration. Raises NeecoError."""
    fx, fy, cx, cy = camera.intrinsics
    size = image_size(where, *camera.size)
    return checked_lens(where, [fx, fy, cx + 0.5, cy + 0.5], camera.distortion, size, fisheye=camera.fisheye)


def checked_lens(
    source: object,
    values: Sequence[Any],
    distortion: Sequence[Any],
    size: tuple[int, int] | None,
    *,
    fisheye: bool = False,
) -> Lens:
    """A lens of fl_x, fl_y, cx, cy px (pixel centres at +0.5) and OpenCV's coefficients. Raises NeecoError."""
    for field, numbers in (("fl_x, fl_y, cx, cy", values), ("distortion", distortion)):
        for value in numbers:
            number = as_float(value)
            if number is None or not abs(number) < MAX_NUMBER:  # NaN compares false
                raise NeecoError(f"{source}: {field}: {printable(value)} is not a usable number; calibrate again")
    if len(values) != 4 or min(values[:2]) <= 0:
        raise NeecoError(f"{source}: fl_x, fl_y: must be two positive focal lengths in pixels; correct them")
    coefficients = tuple(float(value) for value in distortion)
    fl_x, fl_y, cx, cy = (float(value) for value in values)
    if fisheye and len(coefficients) != 4:
        problem = f"a fisheye lens has 4 coefficients, not {len(coefficients)}; calibrate again"
        raise NeecoError(f"{source}: distortion: {problem}")
    if fisheye:  # Kannala & Brandt 2006
        named = dict(zip(FISHEYE_DISTORTION, coefficients, strict=True))
        try:
            coefficients = opencv_distortion(FISHEYE_MODEL, named, (fl_x, fl_y, cx, cy), size)
        except NeecoError as error:
            raise NeecoError(f"{source}: distortion: {error}") from None
    if len(coefficients) not in COEFFICIENT_COUNTS:
        raise NeecoError(f"{source}: distortion: has {len(coefficients)} coefficients; OpenCV has 4, 5, 8, 12 or 14")
    if not any(coefficients):
        coefficients = ()
    return Lens(fl_x, fl_y, cx, cy, coefficients, size)


def image_size(path: Path | str, width: Any, height: Any) -> tuple[int, int] | None:
    """(width, height) px; None where one is not given. Raises NeecoError."""
    if width is None or height is None:
        return None
    sides = [number for value in (width, height) if (number := as_float(value)) is not None]
    if len(sides) < 2 or size_fault(*sides) is not None:
        raise NeecoError(f"{path}: image size: {printable(width)} x {printable(height)} is no image size; correct it")
    return int(width), int(height)


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


def find_border(images: Iterable[np.ndarray]) -> Border | None:
    """The dark border around a round field of view; None when the images have no such border.

    images: uint8 [H, W, 3], frames spread over the recording (10 or more; at most BORDERS.max_frames are used). The
    border stays at the black level although the scene lights up pixels next to it. Only one with a circular edge, sharp
    all along, counts: dark corners of a dim scene are none."""
    stack = [image.max(axis=2).astype(np.float32) for image in islice(images, BORDERS.max_frames)]
    if not stack or min(stack[0].shape) < 32:
        return None
    # the second brightest of ten, so that one flash or one damaged frame does not light up the border
    brightness = ndimage.gaussian_filter(np.percentile(np.stack(stack), 90, axis=0), 1.0)
    # the brightness between border and scene, from the corners' black level up
    height, width = brightness.shape
    size = max(min(height, width) // 40, 2)
    ends = (slice(size), slice(-size, None))
    corners = [brightness[rows, columns] for rows in ends for columns in ends]
    black = sorted(float(np.median(corner)) for corner in corners)[1]
    spread = max(float(np.median([np.std(corner) for corner in corners])), 0.5)
    scene = float(np.percentile(brightness[height // 4 : -height // 4, width // 4 : -width // 4], 25))
    if black > BORDERS.max_black or scene < black + 6 * spread + 4:
        return None
    threshold = black + max(0.15 * (scene - black), 4 * spread)
    # the dark regions that hold a corner of the image
    labels, _ = ndimage.label(ndimage.binary_opening(brightness < threshold, iterations=1))
    outside = np.isin(labels, list({int(labels[row, column]) for row in (1, -2) for column in (1, -2)} - {0}))
    if outside.sum() < 0.01 * outside.size:
        return None
    # the pixels of the scene next to them, without those at the image's edge
    edge = ndimage.binary_dilation(outside) & ~outside
    edge[:2] = edge[-2:] = False
    edge[:, :2] = edge[:, -2:] = False
    rows, columns = np.nonzero(edge)
    circle = _fit_circle(np.stack([columns, rows], axis=1).astype(np.float64))
    if circle is None or not _divides_dark_from_bright(circle, outside, brightness, threshold):
        return None
    x, y, radius = circle
    return x + 0.5, y + 0.5, radius  # which the circle counts from the first pixel's centre


def visible_mask(border: Border, size: tuple[int, int]) -> np.ndarray:
    """bool [H, W] of images of `size` (width, height): False on the border and on its blurred edge."""
    x, y, radius = border
    rows, columns = np.indices(size[::-1])
    return np.hypot(columns + 0.5 - x, rows + 0.5 - y) < radius * (1 - BORDERS.edge_margin) - 0.5


def _fit_circle(points: np.ndarray) -> tuple[float, float, float] | None:
    """Centre and radius of the circle through most points [M, 2]: Kasa's (1976), then with a robust loss."""
    if len(points) < 30:
        return None
    center = points.mean(axis=0)
    local = points - center
    a, b, c = np.linalg.lstsq(np.column_stack([2 * local, np.ones(len(local))]), (local**2).sum(axis=1))[0]

    def misfits(circle: np.ndarray) -> np.ndarray:
        return np.asarray(np.hypot(local[:, 0] - circle[0], local[:, 1] - circle[1]) - circle[2])

    start = np.array([a, b, np.sqrt(max(c + a * a + b * b, 1e-9))])
    x, y, radius = least_squares(misfits, start, loss="cauchy", f_scale=0.6).x
    if np.median(np.abs(misfits(np.array([x, y, radius])))) > max(BORDERS.max_misfit * radius, 1.0):
        return None
    return float(center[0] + x), float(center[1] + y), float(radius)


def _divides_dark_from_bright(
    circle: tuple[float, float, float], outside: np.ndarray, brightness: np.ndarray, threshold: float
) -> bool:
    """Return whether the circle is a plausible edge of the field of view, and divides dark from bright."""
    x, y, radius = circle
    height, width = outside.shape
    if not (0.25 * min(width, height) < radius < 0.75 * max(width, height)):
        return False
    if not (0.25 * width < x < 0.75 * width and 0.2 * height < y < 0.8 * height):
        return False
    rows, columns = np.indices(outside.shape)
    distance = np.hypot(columns - x, rows - y)
    misfit, clean = 2 * BORDERS.max_misfit, BORDERS.min_clean
    beyond, within = distance > radius * (1 + misfit) + 1, distance < radius * (1 - misfit) - 1
    if beyond.sum() < 0.01 * beyond.size:
        return False
    ring = within & (distance > 0.9 * radius)
    bright = np.mean(brightness[ring] >= threshold) if ring.any() else 0.0
    if np.mean(outside[beyond]) <= clean or np.mean(outside[within]) >= 1 - clean or bright <= clean:
        return False
    # a vignette darkens slowly; an edge does it within a few pixels
    black = float(np.percentile(brightness[beyond], 10))
    inner = float(np.median(brightness[(distance > 0.94 * radius) & (distance < 0.98 * radius)]))
    outer = float(np.median(brightness[(distance > 1.02 * radius) & (distance < 1.06 * radius)]))
    return inner - outer > BORDERS.min_edge_drop * (inner - black)
