"""Shapes of masks: boxes, minimum-area rectangles, polygons.

Coordinates are pixel edges: the pixel in column x, row y covers [x, x + 1] x [y, y + 1].
"""

from __future__ import annotations

import numpy as np
from scipy import ndimage
from scipy.spatial import ConvexHull

SIMPLIFY_PX = 0.8  # a straight edge drawn in pixels strays less than this from its line
SIMPLIFY_AREA = 0.02  # a simpler polygon may change the area by this share


def bounding_box(mask: np.ndarray) -> tuple[int, int, int, int]:
    """The box (x, y, width, height) of the extreme pixels of a mask [H, W]; all 0 for an empty mask."""
    rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
    if len(rows) == 0:
        return 0, 0, 0, 0
    x, y = int(columns[0]), int(rows[0])
    return x, y, int(columns[-1]) + 1 - x, int(rows[-1]) + 1 - y


def minimum_rectangle(mask: np.ndarray) -> np.ndarray | None:
    """Corners [4, 2] (x, y) of the smallest rectangle, in any direction, round all pixels of a mask; None when empty.

    Rotating calipers on the convex hull (Toussaint 1983): the smallest rectangle shares a side with the hull.
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
    polygons = [_simplified(loop) for loop in _boundary_loops(mask) if signed_area(loop) > 0]
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


def _boundary_loops(mask: np.ndarray) -> list[np.ndarray]:
    """Closed loops of corners round every piece and hole of a mask, along pixel edges, the inside to the right."""
    padded = np.pad(mask.astype(bool), 1)
    inside = padded[1:-1, 1:-1]
    sides = (  # (neighbour outside, start corner, end corner), corners as (dx, dy) from the pixel's
        (~padded[:-2, 1:-1], (0, 0), (1, 0)),
        (~padded[1:-1, 2:], (1, 0), (1, 1)),
        (~padded[2:, 1:-1], (1, 1), (0, 1)),
        (~padded[1:-1, :-2], (0, 1), (0, 0)),
    )
    onward: dict[tuple[int, int], list[tuple[int, int]]] = {}
    for outside, (sx, sy), (ex, ey) in sides:
        rows, columns = np.nonzero(inside & outside)
        for x, y in zip(columns.tolist(), rows.tolist(), strict=True):
            onward.setdefault((x + sx, y + sy), []).append((x + ex, y + ey))
    loops = []
    while onward:
        start = previous = next(iter(onward))
        loop, here = [start], onward[start].pop()
        if not onward[start]:
            del onward[start]
        while here != start:
            choices = onward[here]
            # two pixels that touch at a corner are two pieces: turn right there
            right = (here[0] - (here[1] - previous[1]), here[1] + (here[0] - previous[0]))
            step = choices[0] if len(choices) == 1 or choices[0] == right else choices[1]
            choices.remove(step)
            if not choices:
                del onward[here]
            loop.append(here)
            previous, here = here, step
        loops.append(np.array(loop, dtype=float))
    return loops


def _simplified(loop: np.ndarray) -> np.ndarray:
    """The loop with fewer corners (Douglas and Peucker 1973), its area kept within SIMPLIFY_AREA."""
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
