"""The optics of the images: the lens of a calibration file, and the round field of view."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from scipy import ndimage
from scipy.optimize import least_squares

from neeco.base.errors import NeecoError
from neeco.base.files import require_file
from neeco.base.plausible import size_fault
from neeco.base.settings import faults_in
from neeco.capture.documents import Node, as_float, printable
from neeco.capture.readers.cameras import opencv_distortion, stated_distortion
from neeco.geometry.camera import COEFFICIENT_COUNTS
from neeco.geometry.lens import Border, Lens
from neeco.ingest.calibration.camera_fields import EXPECTED, CameraNumbers, cameras_in, read_calibration

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
