"""Camera models of nerfstudio, COLMAP and instant-ngp, as coefficients of OpenCV's distortion model."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from neeco.capture.documents import Node, as_float, printable
from neeco.errors import NeecoError

FISHEYE = ("OPENCV_FISHEYE", "FISHEYE", "EQUIDISTANT", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE")
POLYNOMIAL = ("PINHOLE", "SIMPLE_PINHOLE", "PERSPECTIVE", "OPENCV", "SIMPLE_RADIAL", "RADIAL", "FULL_OPENCV")
MODELS = (*POLYNOMIAL, *FISHEYE)
NAMES = ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2")
LISTS = ("distortion_params", "distortion_coefficients", "distortion")  # keys of bare lists of coefficients
NOT_READ = ("ftheta_p0", "ftheta_p1", "latlong", "orthographic")  # instant-ngp's keys of lenses that are none of MODELS
# order of a bare list of coefficients, by its length: six are nerfstudio's, the rest OpenCV's
LISTED = {
    4: ("k1", "k2", "p1", "p2"),
    5: ("k1", "k2", "p1", "p2", "k3"),
    6: ("k1", "k2", "k3", "k4", "p1", "p2"),
    8: ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
}
WIDEST_ANGLE = math.radians(80)  # off the axis, that a lens fitted by OpenCV's rational model may see
MISFIT_PX = 0.1  # largest error of that fit


@dataclass(frozen=True)
class StatedDistortion:
    """What a file says of a lens's distortion: one of MODELS, and the coefficients that are not 0, by NAMES."""

    model: str
    coefficients: Mapping[str, float]
    place: Node | None  # of what tells it: a fisheye model or the first coefficient; None: there is no distortion


def stated_distortion(node_of: Callable[[str], Node]) -> StatedDistortion | None:
    """Read a lens's distortion as nerfstudio and instant-ngp write it; `node_of` gives the value of a key.

    None, and reported, where it cannot be read.
    """
    named = node_of("camera_model")
    model = str(named.value or "PINHOLE").upper()
    if node_of("is_fisheye").value is True:
        model = "OPENCV_FISHEYE"
    wrong = [node for key in NOT_READ if (node := node_of(key)).value]
    wrong += [named] if model not in MODELS else []
    if wrong:
        message = f"is {printable(wrong[0].value)}; this lens model cannot be undistorted"
        wrong[0].error(message, "undistort the images first, and write PINHOLE")
        return None
    found: dict[str, Node] = {}
    for key in LISTS:
        node = node_of(key)
        zeros = isinstance(node.value, list) and all(as_float(item) == 0 for item in node.value)
        if node.value is None or isinstance(node.value, str) or zeros:  # text is a remark
            continue
        names = LISTED.get(len(node.value)) if isinstance(node.value, list) else None
        if names is None:
            node.error(f"expected 4, 5, 6 or 8 coefficients, found {printable(node.value)}", "correct it")
            return None
        found |= dict(zip(NAMES[:4] if model in FISHEYE and len(names) == 4 else names, node.items(), strict=True))
    for name in NAMES:
        node = node_of(name)
        if node.value is None or (as_float(node.value) == 0 and name in found):
            continue
        if name in found and found[name].value != node.value:
            node.error(f"is {printable(node.value)}, and {found[name].field} is another", "state each once")
            return None
        found.setdefault(name, node)
    numbers = {name: node.number() for name, node in found.items()}
    known = {name: number for name, number in numbers.items() if number}
    if None in numbers.values():
        return None
    if model in FISHEYE:
        return StatedDistortion(model, known, named if named.value else node_of("is_fisheye"))
    return StatedDistortion(model, known, found[min(known, key=NAMES.index)] if known else None)


def opencv_distortion(
    model: str,
    coefficients: Mapping[str, float],
    intrinsics: tuple[float, float, float, float],
    size: tuple[int, int] | None,
) -> tuple[float, ...]:
    """OpenCV's k1, k2, p1, p2[, k3, k4, k5, k6] of a lens of one of MODELS; empty without distortion.

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
            raise NeecoError("a fisheye lens has coefficients k1 to k4 alone; calibrate again")
        return fit_rational(lambda angle: angle * _polynomial(angle**2, (k1, k2, k3, k4)), intrinsics, size)
    if k4 and not (k5 or k6 or model == "FULL_OPENCV"):  # nerfstudio's, of the radius to the eighth power
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
    """OpenCV's eight coefficients of the rational model that shows rays where `bend` does, to MISFIT_PX or better.

    bend: angles [N] off the axis, rad, to radii [N] in the image, in focal lengths. Least squares, reweighted by the
    denominator. Raises NeecoError ("what is wrong; what to do").
    """
    fl_x, fl_y, cx, cy = intrinsics
    width, height = size or (2 * cx, 2 * cy)
    theta = np.linspace(1e-3, WIDEST_ANGLE, 2000)
    bent = bend(theta)
    beyond = bent > math.hypot(max(cx, width - cx) / fl_x, max(cy, height - cy) / fl_y)
    used = slice(int(np.argmax(beyond)))
    if not beyond.any() or (np.diff(bent[used]) <= 0).any():
        what = f"sees farther than {math.degrees(WIDEST_ANGLE):.0f} degrees off its axis, or folds the image over"
        raise NeecoError(f"this lens {what}; crop the images, or calibrate again")
    radius, share = np.tan(theta[used]), bent[used] / np.tan(theta[used])
    powers = (radius[:, None] ** 2) ** np.arange(1, 4)  # [N, 3]
    weight = radius
    for _ in range(8):
        rows = np.hstack([powers, -share[:, None] * powers]) * weight[:, None]
        found = np.linalg.lstsq(rows, (share - 1) * weight, rcond=None)[0]
        weight = radius / np.maximum(1 + powers @ found[3:], 1e-6)
    error = np.abs((1 + powers @ found[:3]) / (1 + powers @ found[3:]) - share) * radius * max(fl_x, fl_y)
    if not error.max() < MISFIT_PX:
        raise NeecoError(
            f"this lens bends too much for OpenCV's rational model ({error.max():.2f} px off); crop the images, or "
            "calibrate again"
        )
    return (*found[:2].tolist(), 0.0, 0.0, *found[2:].tolist())


def _polynomial(squares: np.ndarray, coefficients: tuple[float, ...]) -> np.ndarray:
    """1 + k1 s + k2 s^2 + ... of squares s [N]."""
    return np.asarray(np.polynomial.polynomial.polyval(squares, (1.0, *coefficients)))
