"""Shapes of masks: boxes, minimum-area rectangles, polygons.

Coordinates are pixel edges: the pixel in column x, row y covers [x, x + 1] x [y, y + 1].
"""

from __future__ import annotations

import cv2
import numpy as np
from scipy import ndimage
from scipy.spatial import ConvexHull

SIMPLIFY_PX = 0.8  # a straight edge drawn in pixels strays less than this from its line
SIMPLIFY_AREA = 0.02  # a simpler polygon may change the area by this share
FINE = 4  # times as large are pixels drawn to find their edges


def bounding_box(mask: np.ndarray) -> tuple[int, int, int, int]:
    """The box (x, y, width, height) of the extreme pixels of a mask [H, W]; all 0 for an empty mask."""
    x, y, width, height = cv2.boundingRect(mask.astype(np.uint8))
    return x, y, width, height


def minimum_rectangle(mask: np.ndarray) -> np.ndarray | None:
    """Corners [4, 2] (x, y) of the smallest rectangle, in any direction, round all pixels of a mask; None when empty.

    Rotating calipers on the convex hull (Toussaint 1983): the smallest rectangle shares a side with the hull. Our own:
    cv2.minAreaRect reckons in float32 and leaves corners of pixels outside.
    """
    # the first and last pixel of every row carry the hull
    rows = np.flatnonzero(mask.any(1))
    if len(rows) == 0:
        return None
    first = mask[rows].argmax(1)
    last = mask.shape[1] - mask[rows, ::-1].argmax(1)
    corners = np.concatenate([np.stack([x, rows + dy], 1) for x in (first, last) for dy in (0, 1)]).astype(float)
    hull = corners[ConvexHull(corners).vertices]
    edges = np.roll(hull, -1, axis=0) - hull
    along = edges / np.linalg.norm(edges, axis=1, keepdims=True)  # [E, 2]
    across = np.stack([-along[:, 1], along[:, 0]], 1)
    u, v = hull @ along.T, hull @ across.T  # [P, E]
    best = int(((u.max(0) - u.min(0)) * (v.max(0) - v.min(0))).argmin())
    low_u, high_u, low_v, high_v = u[:, best].min(), u[:, best].max(), v[:, best].min(), v[:, best].max()
    ends = np.array([[low_u, low_v], [high_u, low_v], [high_u, high_v], [low_u, high_v]])
    return ends @ np.stack([along[best], across[best]])


def without_speckle(mask: np.ndarray, share: float) -> np.ndarray:
    """The mask without the (edge-connected) pieces smaller than `share` of its largest piece."""
    pieces, count = ndimage.label(mask)
    if count < 2:
        return mask
    areas = np.bincount(pieces.ravel())[1:]
    keep = np.concatenate([[False], areas >= share * areas.max()])
    return keep[pieces]


def outer_polygons(mask: np.ndarray) -> list[np.ndarray]:
    """The outer contour [P, 2] (x, y) of every piece of a mask, largest first, simplified; holes are filled."""
    polygons = [_simplified(loop) for loop in _outer_loops(mask)] if mask.any() else []
    return sorted(polygons, key=lambda polygon: -abs(signed_area(polygon)))


def signed_area(polygon: np.ndarray) -> float:
    """Area of a polygon [P, 2], positive when it runs clockwise as seen in the image (y down)."""
    x, y = polygon[:, 0], polygon[:, 1]
    return float(0.5 * np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y))


def joined_polygon(polygons: list[np.ndarray]) -> np.ndarray:
    """One polygon [P, 2] out of several, joined by bridges of no width between their nearest corners."""
    joined, *rest = polygons
    remaining = list(rest)
    while remaining:
        gaps = [np.linalg.norm(joined[:, None] - other[None], axis=2) for other in remaining]
        nearest = int(np.argmin([gap.min() for gap in gaps]))
        here, there = np.unravel_index(gaps[nearest].argmin(), gaps[nearest].shape)
        other = np.roll(remaining.pop(nearest), -int(there), axis=0)
        joined = np.concatenate([joined[: here + 1], other, other[:1], joined[here:]])
    return joined


def _outer_loops(mask: np.ndarray) -> list[np.ndarray]:
    """A closed loop of corners [P, 2] (x, y) round every (edge-connected) piece of a mask, along pixel edges.

    OpenCV joins the centres of pixels, and pixels that touch at a corner alone. Of pixels drawn FINE times as large
    every centre has one nearest corner; where two touch at a corner alone, what touches is cut away.
    """
    x, y, width, height = bounding_box(mask)
    inside = mask[y : y + height, x : x + width].astype(np.uint8)
    fine = np.kron(inside, np.ones((FINE, FINE), np.uint8))
    upper_left, upper_right, lower_left, lower_right = (
        inside[:-1, :-1],
        inside[:-1, 1:],
        inside[1:, :-1],
        inside[1:, 1:],
    )
    touching = (upper_left == lower_right) & (upper_right == lower_left) & (upper_left != upper_right)
    for row, column in FINE * (np.argwhere(touching) + 1):
        fine[row - 1 : row + 1, column - 1 : column + 1] = 0
    contours, hierarchy = cv2.findContours(fine, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
    loops = []
    for contour, (*_, parent) in zip(contours[::-1], hierarchy[0][::-1], strict=True):
        if parent >= 0:  # a hole
            continue
        corners = (contour[::-1, 0] + FINE // 2) // FINE  # clockwise as seen
        corners = corners[(corners != np.roll(corners, 1, axis=0)).any(1)]
        first = np.lexsort(corners.T)[0]  # the leftmost of the top row
        loops.append(np.roll(corners, -first, axis=0) + np.array([x, y], dtype=float))
    return loops


def _simplified(loop: np.ndarray) -> np.ndarray:
    """The loop with fewer corners (Douglas and Peucker 1973), its area kept within SIMPLIFY_AREA.

    Our own: drawn again, polygons of cv2.approxPolyDP agree less with their masks (mean IoU .976 instead of .978).
    """
    area = signed_area(loop)
    tolerance = SIMPLIFY_PX
    while tolerance > 0.1:
        simple = _douglas_peucker(loop, tolerance)
        if len(simple) >= 3 and abs(signed_area(simple) - area) <= SIMPLIFY_AREA * area:
            return simple
        tolerance /= 2
    return _douglas_peucker(loop, 1e-9)  # only collinear corners go


def _douglas_peucker(loop: np.ndarray, tolerance: float) -> np.ndarray:
    # cut the loop open at its corner farthest from the first
    far = int(np.linalg.norm(loop - loop[0], axis=1).argmax())
    closed = np.concatenate([loop, loop[:1]])
    keep = np.zeros(len(closed), dtype=bool)
    keep[[0, far, -1]] = True
    stack = [(0, far), (far, len(closed) - 1)]
    while stack:
        first, last = stack.pop()
        if last - first < 2:
            continue
        chord = closed[last] - closed[first]
        offsets = closed[first + 1 : last] - closed[first]
        distances = np.abs(offsets[:, 0] * chord[1] - offsets[:, 1] * chord[0]) / max(float(np.hypot(*chord)), 1e-12)
        worst = int(distances.argmax())
        if distances[worst] > tolerance:
            middle = first + 1 + worst
            keep[middle] = True
            stack += [(first, middle), (middle, last)]
    return closed[:-1][keep[:-1]]
