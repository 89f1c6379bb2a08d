"""Outlines of what moves in the images: how far pixels are from one, and the line and tip of a shaft in each mask."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.ndimage import distance_transform_edt, gaussian_filter

ELONGATED = 2.0  # length over width from which a mask's piece has the direction of a shaft
SMALLEST_SHARE = 0.002  # of the image: smaller pieces of a mask are noise
EDGE_PX = 2  # a piece that comes this near to the image's border goes on beyond it
SMOOTH_PX = 1.5  # of distances: the steps of a mask's outline would be taken for its shape


@dataclass(frozen=True, eq=False)
class Silhouettes:
    """Masks [F, h, w] of what moves, as signed distances px to their outlines (inside positive), and the pinhole they
    are seen through (fx, fy, cx, cy, px of the masks)."""

    masks: np.ndarray  # bool [F, h, w]
    distances: np.ndarray  # float32 [F, h, w]
    intrinsics: tuple[float, float, float, float]
    corners: np.ndarray  # [F, C, 2] px of the convex hull of each mask's shaft, NaN where it shows none or its tip not

    def look_up(self, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Signed distances [F, N] px at places x, y [F, N] px, between pixel centres bilinear, and their gradients
        [F, N, 2]. Beyond the image both are those of its border."""
        count, height, width = self.distances.shape
        u = np.clip(x - 0.5, 0, width - 1.001)
        v = np.clip(y - 0.5, 0, height - 1.001)
        column, row = u.astype(np.int64), v.astype(np.int64)
        a, b = u - column, v - row
        flat = self.distances.reshape(-1)
        base = (np.arange(count)[:, None] * height + row) * width + column
        d00, d01, d10, d11 = flat[base], flat[base + 1], flat[base + width], flat[base + width + 1]
        top, bottom = d00 + a * (d01 - d00), d10 + a * (d11 - d10)
        gradient = np.stack([(1 - b) * (d01 - d00) + b * (d11 - d10), bottom - top], -1)
        return top + b * (bottom - top), gradient

    def extent(self, directions: np.ndarray) -> np.ndarray:
        """[F] px: how far the piece with the shaft reaches along unit directions [F, 2]; NaN where its tip is not
        seen."""
        return np.asarray(np.einsum("fcj,fj->fc", self.corners, directions).max(1))

    def inside(self, x: np.ndarray, y: np.ndarray, margin: float = 0.0) -> np.ndarray:
        """bool [F, N]: places in the image, `margin` px from its border."""
        _, height, width = self.distances.shape
        return (x > margin) & (x < width - margin) & (y > margin) & (y < height - margin)

    def take(self, rows: np.ndarray) -> Silhouettes:
        """Some of the frames."""
        return Silhouettes(self.masks[rows], self.distances[rows], self.intrinsics, self.corners[rows])


def silhouettes_of(
    masks: np.ndarray, intrinsics: tuple[float, float, float, float], hidden: np.ndarray | None = None
) -> Silhouettes:
    """masks: bool [F, h, w]; hidden: bool [h, w], what lies beyond a round border, where no outline is real."""
    unknown = np.zeros(masks.shape[1:], dtype=bool) if hidden is None else hidden
    found = np.empty(masks.shape, dtype=np.float32)
    for row, mask in enumerate(masks):
        inner, outer = mask | unknown, ~mask | unknown
        inside = distance_transform_edt(inner) if not inner.all() else np.full(mask.shape, np.inf)
        outside = distance_transform_edt(outer) if not outer.all() else np.full(mask.shape, np.inf)
        signed = np.where(mask, inside - 0.5, 0.5 - outside)
        limit = float(np.hypot(*mask.shape))
        found[row] = gaussian_filter(np.clip(signed, -limit, limit), SMOOTH_PX, mode="nearest")
    return Silhouettes(masks & ~unknown, found, intrinsics, shaft_lines(masks & ~unknown, hidden).corners)


@dataclass(frozen=True, eq=False)
class ShaftLines:
    """The line of a shaft and the tip it ends in, as each frame's mask shows them, px; NaN where it shows none."""

    points: np.ndarray  # [F, 2] on the line
    directions: np.ndarray  # [F, 2] unit, towards the tip
    tips: np.ndarray  # [F, 2]
    corners: np.ndarray  # [F, C, 2] of the convex hull of the piece, where its tip is seen


def shaft_lines(masks: np.ndarray, hidden: np.ndarray | None = None) -> ShaftLines:
    """Lines and tips of the largest elongated piece of each mask [F, h, w] that comes in at the image's border."""
    count, height, width = masks.shape
    points, directions, tips = (np.full((count, 2), np.nan) for _ in range(3))
    hulls: list[np.ndarray] = [np.full((1, 2), np.nan)] * count
    border = np.zeros((height, width), dtype=bool)
    border[:EDGE_PX], border[-EDGE_PX:], border[:, :EDGE_PX], border[:, -EDGE_PX:] = True, True, True, True
    if hidden is not None:
        border |= cv2.dilate(hidden.astype(np.uint8), np.ones((2 * EDGE_PX + 1,) * 2, np.uint8)).astype(bool)
    for row, mask in enumerate(masks):
        pieces, labels, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=8)
        if pieces < 2:
            continue
        largest = 1 + int(np.argmax(stats[1:, cv2.CC_STAT_AREA]))
        if stats[largest, cv2.CC_STAT_AREA] < SMALLEST_SHARE * mask.size:
            continue
        v, u = np.nonzero(labels == largest)
        places = np.stack([u, v], -1) + 0.5
        center = places.mean(0)
        values, vectors = np.linalg.eigh(np.cov((places - center).T))
        if values[1] < ELONGATED**2 * max(values[0], 1e-9):
            continue
        along = (places - center) @ vectors[:, 1]
        touching = border[v, u]
        if not touching.any():
            continue
        # the end farther from where it comes in is the tip
        sign = -1.0 if np.median(along[touching]) > 0 else 1.0
        direction, along = sign * vectors[:, 1], sign * along
        points[row], directions[row] = center, direction
        end = along > along.max() - 2.0
        if not touching[end].any():
            tips[row] = places[end].mean(0)
            hulls[row] = cv2.convexHull(places.astype(np.float32))[:, 0]
    most = max((len(hull) for hull in hulls), default=1)
    padded = [hull[np.arange(most) % len(hull)] for hull in hulls]
    corners = np.array(padded, np.float64).reshape(count, most, 2)
    return ShaftLines(points, directions, tips, corners)
