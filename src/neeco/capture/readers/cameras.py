"""Cameras and lenses as files state them: camera models of nerfstudio, COLMAP, instant-ngp; the `lens` block."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
import torch

from neeco.base.errors import NeecoError
from neeco.base.plausible import PLAUSIBLE, focal_fault, size_fault
from neeco.capture.documents import Node, as_float, printable
from neeco.capture.images import image_size
from neeco.capture.readers.parsed import Parsed
from neeco.geometry.camera import COEFFICIENT_COUNTS, Camera
from neeco.geometry.lens import BORDER, COEFFICIENT_NAMES, INTRINSICS, Border, Lens

MAX_PX = 65_536.0  # beyond any image
MAX_COEFFICIENT = 1e6  # beyond any lens
FISHEYE = ("OPENCV_FISHEYE", "FISHEYE", "EQUIDISTANT", "SIMPLE_FISHEYE", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE")
POLYNOMIAL = ("PINHOLE", "SIMPLE_PINHOLE", "PERSPECTIVE", "OPENCV", "SIMPLE_RADIAL", "RADIAL", "FULL_OPENCV")
MODELS = (*POLYNOMIAL, *FISHEYE)
NAMES = ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2")
LISTS = ("distortion_params", "distortion_coefficients", "distortion")  # keys of bare lists of coefficients
NOT_READ = ("ftheta_p0", "ftheta_p1", "latlong", "orthographic")  # instant-ngp's keys of unsupported lenses
# order of a bare list of coefficients, by its length: six are nerfstudio's, the rest OpenCV's
LISTED = {
    4: ("k1", "k2", "p1", "p2"),
    5: ("k1", "k2", "p1", "p2", "k3"),
    6: ("k1", "k2", "k3", "k4", "p1", "p2"),
    8: ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
}
MAX_ANGLE = math.radians(80)  # maximum angle from the axis of a lens fitted by OpenCV's rational model
MAX_MISFIT_PX = 0.1  # largest error of that fit


@dataclass(frozen=True)
class StatedDistortion:
    """Distortion of a lens as stated in a file: one of MODELS, and the non-zero coefficients, by NAMES."""

    model: str
    coefficients: Mapping[str, float]
    place: Node | None  # node of the fisheye model or the first coefficient; None: no distortion


def stated_distortion(node_of: Callable[[str], Node]) -> StatedDistortion:
    """Read a lens's distortion as written by nerfstudio and instant-ngp; node_of: returns the node of a key. Raises
    Fault if it is invalid."""
    model_node = node_of("camera_model")
    model = str(model_node.value or "PINHOLE").upper()
    if node_of("is_fisheye").value is True:
        model = "OPENCV_FISHEYE"
    unsupported = [node for key in NOT_READ if (node := node_of(key)).value]
    for node in unsupported + ([model_node] if model not in MODELS else []):
        message = f"is {printable(node.value)}: this lens model cannot be undistorted"
        node.fail(message, "undistort the images first, and write PINHOLE")
    nodes: dict[str, Node] = {}
    for key in LISTS:
        node = node_of(key)
        zeros = isinstance(node.value, list) and all(as_float(item) == 0 for item in node.value)
        if node.value is None or isinstance(node.value, str) or zeros:  # text is a comment
            continue
        names = LISTED.get(len(node.value)) if isinstance(node.value, list) else None
        if names is None:
            node.fail(f"expected 4, 5, 6 or 8 coefficients, found {printable(node.value)}", "correct it")
        nodes |= dict(zip(NAMES[:4] if model in FISHEYE and len(names) == 4 else names, node.items(), strict=True))
    for name in NAMES:
        node = node_of(name)
        if node.value is None or (as_float(node.value) == 0 and name in nodes):
            continue
        if name in nodes and nodes[name].value != node.value:
            node.fail(f"is {printable(node.value)}, but {nodes[name].field} differs", "state each once")
        nodes.setdefault(name, node)
    coefficients = {name: number for name, node in nodes.items() if (number := node.number())}
    if model in FISHEYE:
        return StatedDistortion(model, coefficients, model_node if model_node.value else node_of("is_fisheye"))
    return StatedDistortion(model, coefficients, nodes[min(coefficients, key=NAMES.index)] if coefficients else None)


def opencv_distortion(
    model: str,
    coefficients: Mapping[str, float],
    intrinsics: tuple[float, float, float, float],
    size: tuple[int, int] | None,
) -> tuple[float, ...]:
    """Return OpenCV's k1, k2, p1, p2[, k3, k4, k5, k6] of a lens of one of MODELS; empty without distortion.

    coefficients: by NAMES, absent ones are 0. intrinsics: fl_x, fl_y, cx, cy px; size: (width, height) px, None: twice
    the principal point. Other models than OpenCV's are fitted. Raises NeecoError ("what is wrong; what to do").
    """
    return _opencv_distortion(model, tuple(coefficients.get(name, 0.0) for name in NAMES), intrinsics, size)


@lru_cache(maxsize=8)
def _opencv_distortion(
    model: str,
    coefficients: tuple[float, ...],
    intrinsics: tuple[float, float, float, float],
    size: tuple[int, int] | None,
) -> tuple[float, ...]:
    k1, k2, k3, k4, k5, k6, p1, p2 = coefficients
    if model in FISHEYE:
        if any((k5, k6, p1, p2)):
            raise NeecoError("a fisheye lens has only coefficients k1 to k4; calibrate again")
        return fit_rational(lambda angle: angle * _polynomial(angle**2, (k1, k2, k3, k4)), intrinsics, size)
    if k4 and not (k5 or k6 or model == "FULL_OPENCV"):  # nerfstudio's k4, coefficient of the radius' eighth power
        radial = fit_rational(lambda a: np.tan(a) * _polynomial(np.tan(a) ** 2, (k1, k2, k3, k4)), intrinsics, size)
        return (*radial[:2], p1, p2, *radial[4:])
    if k4 or k5 or k6:
        return k1, k2, p1, p2, k3, k4, k5, k6
    return (k1, k2, p1, p2, k3) if any((k1, k2, p1, p2, k3)) else ()


def fit_rational(
    bend: Callable[[np.ndarray], np.ndarray],
    intrinsics: tuple[float, float, float, float],
    size: tuple[int, int] | None,
) -> tuple[float, ...]:
    """Fit OpenCV's rational model of eight coefficients to the radial distortion `bend`, to MAX_MISFIT_PX or better.

    bend: angles [N] from the axis, rad, to radii [N] in the image, in focal lengths. Least squares, reweighted by the
    denominator. Raises NeecoError ("what is wrong; what to do").
    """
    fl_x, fl_y, cx, cy = intrinsics
    width, height = size or (2 * cx, 2 * cy)
    theta = np.linspace(1e-3, MAX_ANGLE, 2000)
    bent = bend(theta)
    beyond = bent > math.hypot(max(cx, width - cx) / fl_x, max(cy, height - cy) / fl_y)
    used = slice(int(np.argmax(beyond)))
    if not beyond.any() or (np.diff(bent[used]) <= 0).any():
        problem = f"covers more than {math.degrees(MAX_ANGLE):.0f} degrees from its axis, or is not monotonic"
        raise NeecoError(f"this lens {problem}; crop the images, or calibrate again")
    radius, share = np.tan(theta[used]), bent[used] / np.tan(theta[used])
    powers = (radius[:, None] ** 2) ** np.arange(1, 4)  # [N, 3]
    weight = radius
    for _ in range(8):
        rows = np.hstack([powers, -share[:, None] * powers]) * weight[:, None]
        solution = np.linalg.lstsq(rows, (share - 1) * weight, rcond=None)[0]
        weight = radius / np.maximum(1 + powers @ solution[3:], 1e-6)
    error = np.abs((1 + powers @ solution[:3]) / (1 + powers @ solution[3:]) - share) * radius * max(fl_x, fl_y)
    if not error.max() < MAX_MISFIT_PX:
        raise NeecoError(
            f"OpenCV's rational model does not fit this lens (error {error.max():.2f} px); crop the images, or "
            "calibrate again"
        )
    return (*solution[:2].tolist(), 0.0, 0.0, *solution[2:].tolist())


def _polynomial(squares: np.ndarray, coefficients: tuple[float, ...]) -> np.ndarray:
    """Return 1 + k1 s + k2 s^2 + ... for squares s [N]."""
    return np.asarray(np.polynomial.polynomial.polyval(squares, (1.0, *coefficients)))


def parse_lens(node: Node) -> Lens:
    """Return the lens that a node describes. Raises Fault if it is invalid."""
    stated = node.members()
    width, height = (node.child(key).integer(least=1) for key in ("w", "h"))
    fl_x, fl_y = (node.child(key).number(above=0, below=MAX_PX) for key in INTRINSICS[:2])
    cx, cy = (node.child(key).number(above=-MAX_PX, below=MAX_PX) for key in INTRINSICS[2:])
    # the coefficients up to the last stated one, padded to the number of one of OpenCV's models
    last = max((k for k, name in enumerate(COEFFICIENT_NAMES, 1) if node.has(name)), default=0)
    names = COEFFICIENT_NAMES[: min(count for count in COEFFICIENT_COUNTS if count >= last)]
    distortion = tuple(
        stated[name].number(above=-MAX_COEFFICIENT, below=MAX_COEFFICIENT) if node.has(name) else 0.0 for name in names
    )
    border = node.given("border", _border, None)
    if (fault := size_fault(width, height) or focal_fault(fl_x, fl_y, width, height)) is not None:
        node.fail(*fault)
    lens = Lens(fl_x, fl_y, cx, cy, distortion, (width, height), border=border)
    try:
        lens.pinhole((width, height))
    except NeecoError as error:
        node.fail(str(error).removeprefix("lens: "))
    return lens


def _border(node: Node) -> Border:
    node.members()
    x, y = (node.child(key).number(above=-MAX_PX, below=MAX_PX) for key in BORDER[:2])
    return x, y, node.child(BORDER[2]).number(above=1, below=MAX_PX)


def placeholder_camera(image_path: Path) -> Camera:
    """Return a camera for an image whose camera is invalid, so that image and states can still be checked."""
    width, height = _size_or_largest(image_path)
    return Camera(torch.eye(4), fx=width, fy=width, cx=width / 2, cy=height / 2, width=width, height=height)


def _size_or_largest(image_path: Path) -> tuple[int, int]:
    try:
        return image_size(image_path)
    except NeecoError:  # reported when the images are checked
        return PLAUSIBLE.max_size_px, PLAUSIBLE.max_size_px


class CameraFields:
    """Checked lookup of a camera's numbers, first in the frame, then at the top level; every fault is reported."""

    def __init__(self, frame: Node, document: Node, image_path: Path, parsed: Parsed) -> None:
        self.frame, self.document, self.image_path, self.parsed = frame, document, image_path, parsed

    def camera(self) -> Camera | None:
        """Return the frame's camera at the origin; None, and reported, if its numbers are invalid."""
        stated = self._node("camera_model").tried(lambda _: self._distortion())
        size = self.frame.child("file_path").tried(lambda _: self._size())
        width, height = size or _size_or_largest(self.image_path)
        has_fy = self._has("fl_y", "camera_angle_y")
        fx = self._node("fl_x").tried(self._focal, "camera_angle_x", width)
        fy = self._node("fl_y").tried(self._focal, "camera_angle_y", height) if has_fy else fx
        cx, cy = (self._node(key).tried(_center, side) for key, side in (("cx", width), ("cy", height)))
        if size is None or fx is None or fy is None or cx is None or cy is None or stated is None:
            return None
        if (fault := focal_fault(fx, fy, width, height)) is not None:
            self._node("fl_x" if self._has("fl_x") else "camera_angle_x").error(*fault)
            return None
        distortion = (stated.place or self._node("camera_model")).tried(
            lambda _: opencv_distortion(stated.model, stated.coefficients, (fx, fy, cx, cy), size)
        )
        if distortion is None:
            return None
        return Camera(torch.eye(4), fx=fx, fy=fy, cx=cx, cy=cy, width=width, height=height, distortion=distortion)

    def _has(self, *keys: str) -> bool:
        return any(self.frame.has(key) or self.document.has(key) for key in keys)

    def _node(self, key: str) -> Node:
        return (self.frame if self.frame.has(key) else self.document).child(key)

    def _distortion(self) -> StatedDistortion:
        """Return the stated distortion. Raises Fault if it is invalid, or not zero for images read in place."""
        stated = stated_distortion(self._node)
        if stated.place is not None and not self.parsed.as_source:
            message = f"is {printable(stated.place.value)}: cameras must be PINHOLE, and the images are distorted"
            stated.place.fail(message, f"undistort them: neeco ingest {self.parsed.root} --output CAPTURE")
        return stated

    def _size(self) -> tuple[int, int]:
        """Return (width, height), from the image if not stated."""
        if not self._has("w", "h"):
            try:
                return image_size(self.image_path)
            except NeecoError as error:
                raise NeecoError(str(error).replace(str(self.image_path), printable(self.image_path.name))) from None
        width, height = (_positive(self._node(key)) for key in ("w", "h"))
        if (fault := size_fault(width, height)) is not None:
            self._node("w").fail(*fault)
        return int(width), int(height)

    def _focal(self, node: Node, angle_key: str, extent: int) -> float:
        """Return the focal length in px, from the field of view if only that is stated."""
        if node.value is not None or not self._has(angle_key):
            return _positive(node)
        angle = _positive(self._node(angle_key))
        if angle >= math.pi:
            self._node(angle_key).fail(f"is {angle:g} rad, must be below pi", "give the field of view in radians")
        return 0.5 * extent / math.tan(0.5 * angle)


def _center(node: Node, extent: int) -> float:
    """Return the principal point in px, inside the image; default: the image centre."""
    value = extent / 2 if node.value is None else node.number()
    if not 0 < value < extent:
        node.fail(f"is {value:g}, outside the image (0 .. {extent})", "give it in pixels of this image")
    return value


def _positive(node: Node) -> float:
    if node.value is None:
        node.fail("is missing", "give the camera's intrinsics at the top level or in every frame")
    value = node.number()
    if value <= 0:
        node.fail(f"is {value:g}, must be positive")
    return value
