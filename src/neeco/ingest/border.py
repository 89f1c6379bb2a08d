"""The endoscope's round field of view: what lies outside it is black in every frame and shows nothing."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from scipy import ndimage

DARK = 40.0  # of 255; a border brighter than this in most frames is no border
MARGIN = 0.015  # of the radius taken off: the rim is blurred
MISFIT = 0.015  # of the radius: how far the rim may be off a circle
CLEAN = 0.9  # share of the pixels beyond the rim that must be dark, of those within that must not be
SHARP = 0.6  # share of the brightness inside the rim that must be gone right outside
SAMPLES = 48


def visible_mask(images: Iterable[np.ndarray]) -> np.ndarray | None:
    """bool [H, W], False on the dark border around a round field of view; None when the images have no such border.

    images: uint8 [H, W, 3], frames spread over the recording (10 or more; 48 are used at most). A pixel belongs to
    the border when it stays at the black level although the scene lights up others beside it; only a border whose
    edge is one circle, sharp all along, counts, so that dark corners of a dim scene do not.
    """
    brightness = _brightest(images)
    if brightness is None or min(brightness.shape) < 32:
        return None
    threshold = _threshold(brightness)
    if threshold is None:
        return None
    dark = ndimage.binary_opening(brightness < threshold, iterations=1)
    outside = _touching_corners(dark)
    if outside.sum() < 0.01 * outside.size:
        return None
    rim = _rim(outside)
    circle = _circle(rim)
    if circle is None or not _holds(circle, outside, brightness, threshold):
        return None
    x, y, radius = circle
    rows, columns = np.indices(outside.shape)
    return np.hypot(columns - x, rows - y) < radius * (1 - MARGIN) - 0.5


def _brightest(images: Iterable[np.ndarray]) -> np.ndarray | None:
    """float [H, W]: how bright each pixel gets in its brightest frames, noise smoothed out."""
    stack = []
    for image in images:
        stack.append(image.max(axis=2).astype(np.float32))
        if len(stack) == SAMPLES:
            break
    if not stack:
        return None
    # the second brightest of ten, so that one flash or one damaged frame does not light up the border
    return ndimage.gaussian_filter(np.percentile(np.stack(stack), 90, axis=0), 1.0)


def _threshold(brightness: np.ndarray) -> float | None:
    """The brightness between border and scene, from the corners' black level up."""
    height, width = brightness.shape
    size = max(min(height, width) // 40, 2)
    ends = (slice(size), slice(-size, None))
    corners = [brightness[rows, columns] for rows in ends for columns in ends]
    levels = sorted(float(np.median(corner)) for corner in corners)
    black, spread = levels[1], float(np.median([np.std(corner) for corner in corners]))
    middle = brightness[height // 4 : -height // 4, width // 4 : -width // 4]
    scene = float(np.percentile(middle, 25))
    if black > DARK or scene < black + 6 * max(spread, 0.5) + 4:
        return None
    return black + max(0.15 * (scene - black), 4 * max(spread, 0.5))


def _touching_corners(dark: np.ndarray) -> np.ndarray:
    """The dark regions that hold a corner of the image."""
    labels, _ = ndimage.label(dark)
    found = {int(labels[row, column]) for row in (1, -2) for column in (1, -2)} - {0}
    return np.isin(labels, list(found)) if found else np.zeros_like(dark)


def _rim(outside: np.ndarray) -> np.ndarray:
    """Pixels [M, 2] (x, y) of the scene beside the dark region, not those cut off by the image's edge."""
    edge = ndimage.binary_dilation(outside) & ~outside
    edge[:2] = edge[-2:] = False
    edge[:, :2] = edge[:, -2:] = False
    rows, columns = np.nonzero(edge)
    return np.stack([columns, rows], axis=1).astype(np.float64)


def _circle(points: np.ndarray) -> tuple[float, float, float] | None:
    """Centre and radius of the circle through most points [M, 2] (algebraic fit, Kasa 1976, reweighted)."""
    if len(points) < 30:
        return None
    center = points.mean(axis=0)
    local = points - center
    design = np.column_stack([2 * local, np.ones(len(local))])
    weights = np.ones(len(local))
    for _ in range(20):
        normal = design.T @ (design * weights[:, None]) + 1e-9 * np.eye(3)
        a, b, c = np.linalg.solve(normal, design.T @ (weights * (local**2).sum(axis=1)))
        radius = float(np.sqrt(max(c + a * a + b * b, 1e-9)))
        residuals = np.hypot(local[:, 0] - a, local[:, 1] - b) - radius
        scale = max(1.48 * float(np.median(np.abs(residuals))), 0.3)
        weights = 1 / (1 + (residuals / (2 * scale)) ** 2) ** 2
    if np.median(np.abs(residuals)) > max(MISFIT * radius, 1.0):
        return None
    return float(center[0] + a), float(center[1] + b), radius


def _holds(circle: tuple[float, float, float], outside: np.ndarray, brightness: np.ndarray, threshold: float) -> bool:
    """Whether the circle is a plausible rim, and divides dark from bright cleanly."""
    x, y, radius = circle
    height, width = outside.shape
    if not (0.25 * min(width, height) < radius < 0.75 * max(width, height)):
        return False
    if not (0.25 * width < x < 0.75 * width and 0.2 * height < y < 0.8 * height):
        return False
    rows, columns = np.indices(outside.shape)
    distance = np.hypot(columns - x, rows - y)
    beyond, within = distance > radius * (1 + 2 * MISFIT) + 1, distance < radius * (1 - 2 * MISFIT) - 1
    if beyond.sum() < 0.01 * beyond.size:
        return False
    ring = within & (distance > 0.9 * radius)
    bright = np.mean(brightness[ring] >= threshold) if ring.any() else 0.0
    if np.mean(outside[beyond]) <= CLEAN or np.mean(outside[within]) >= 1 - CLEAN or bright <= CLEAN:
        return False
    # a vignette darkens slowly; a rim does it within a few pixels
    black = float(np.percentile(brightness[beyond], 10))
    inner = float(np.median(brightness[(distance > 0.94 * radius) & (distance < 0.98 * radius)]))
    outer = float(np.median(brightness[(distance > 1.02 * radius) & (distance < 1.06 * radius)]))
    return inner - outer > SHARP * (inner - black)
