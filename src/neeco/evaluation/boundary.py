"""How well contours agree: the boundary F-measure of DAVIS."""

from __future__ import annotations

import math

import numpy as np
from scipy import ndimage

TOLERANCE = 0.008  # of the image's diagonal, as DAVIS


def boundary_pixels(mask: np.ndarray) -> np.ndarray:
    """Contour of a bool mask [H, W], one pixel wide: pixels that differ from their right, lower or lower right
    neighbour. What the image's edge cuts off is no contour."""
    padded = np.pad(mask, ((0, 1), (0, 1)), mode="edge")
    right, lower, diagonal = padded[:-1, 1:], padded[1:, :-1], padded[1:, 1:]
    return (mask ^ right) | (mask ^ lower) | (mask ^ diagonal)


def boundary_f(
    mask: np.ndarray, truth: np.ndarray, counted: np.ndarray | None = None, tolerance: float = TOLERANCE
) -> float:
    """F-measure of two contours: harmonic mean of the shares of each that lie near the other (Perazzi et al., "A
    benchmark dataset and evaluation methodology for video object segmentation", CVPR 2016, section 4.1).

    mask, truth [H, W] bool; near: at most ceil(tolerance * diagonal) pixels apart, centre to centre. counted [H, W]:
    contour pixels outside it need no counterpart, but may be one. NaN when neither mask has a pixel; 1 when there are
    pixels but neither has a contour (both fill the image), 0 when only one has.
    """
    if not (mask.any() or truth.any()):
        return math.nan
    contours = boundary_pixels(mask), boundary_pixels(truth)
    everywhere = np.ones(mask.shape, bool) if counted is None else counted
    judged = [int((contour & everywhere).sum()) for contour in contours]
    if not judged[0] or not judged[1]:
        return float(judged[0] == judged[1] and mask.any() == truth.any())
    radius = math.ceil(tolerance * math.hypot(*mask.shape))
    window = _window(contours[0] | contours[1])  # distances outside it are never asked for
    first, second, inside = (image[window] for image in (*contours, everywhere))
    near_second = ndimage.distance_transform_edt(~second) <= radius
    near_first = ndimage.distance_transform_edt(~first) <= radius
    precision = int((first & inside & near_second).sum()) / judged[0]
    recall = int((second & inside & near_first).sum()) / judged[1]
    return 2 * precision * recall / (precision + recall) if precision + recall else 0.0


def _window(pixels: np.ndarray) -> tuple[slice, slice]:
    rows, columns = np.flatnonzero(pixels.any(axis=1)), np.flatnonzero(pixels.any(axis=0))
    return slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)
