"""Silhouettes of foreground masks: signed distances to their outlines, and the line and tip of a shaft in each."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from scipy.ndimage import distance_transform_edt, gaussian_filter


@dataclass(frozen=True, kw_only=True)
class ShaftLineSettings:
    """Settings of lines of shafts in masks."""

    min_elongation: float = 2.0  # minimum ratio of a shaft's length to its width
    min_area: float = 0.002  # minimum area of a piece, share of the image: smaller ones are noise
    edge_px: int = 2  # distance from the image's border within which a piece continues beyond it
    entering: float = 0.5  # share of a piece, from the border, to which its line is fitted
    min_slices: int = 6  # minimum length along the shaft for that fit, px
    line_rounds: int = 4  # rounds of the robust fit of a line
    smooth_px: float = 1.5  # of distances: the steps of a mask's outline would be taken for its shape


SHAFT_LINES = ShaftLineSettings()


@dataclass(frozen=True, eq=False)
class Silhouettes:
    """Foreground masks [F, h, w], their signed distances px to the outlines (inside positive), and the pinhole (fx, fy,
    cx, cy, px of the masks)."""

    masks: np.ndarray  # bool [F, h, w]
    distances: np.ndarray  # float32 [F, h, w]
    intrinsics: tuple[float, float, float, float]
    shafts: ShaftLines

    def look_up(self, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Signed distances [F, N] px at pixels [F, N, 2], bilinear between centres, and their gradients [F, N, 2].
        Beyond the image both are those of its border."""
        count, height, width = self.distances.shape
        u = np.clip(pixels[..., 0] - 0.5, 0, width - 1.001)
        v = np.clip(pixels[..., 1] - 0.5, 0, height - 1.001)
        column, row = u.astype(np.int64), v.astype(np.int64)
        a, b = u - column, v - row
        flat = self.distances.reshape(-1)
        base = (np.arange(count)[:, None] * height + row) * width + column
        d00, d01, d10, d11 = flat[base], flat[base + 1], flat[base + width], flat[base + width + 1]
        top, bottom = d00 + a * (d01 - d00), d10 + a * (d11 - d10)
        gradient = np.stack([(1 - b) * (d01 - d00) + b * (d11 - d10), bottom - top], -1)
        return top + b * (bottom - top), gradient

    def inside(self, pixels: np.ndarray, margin: float = 0.0) -> np.ndarray:
        """Whether pixels [F, N, 2] are in the image, `margin` px from its border, bool [F, N]."""
        size = np.array(self.distances.shape[:0:-1])
        return np.asarray(((pixels > margin) & (pixels < size - margin)).all(-1))

    def take(self, rows: np.ndarray) -> Silhouettes:
        """Return those of some of the frames."""
        return Silhouettes(self.masks[rows], self.distances[rows], self.intrinsics, self.shafts.take(rows))


def silhouettes_of(
    masks: np.ndarray, intrinsics: tuple[float, float, float, float], hidden: np.ndarray | None = None
) -> Silhouettes:
    """Return the silhouettes of masks bool [F, h, w]. hidden: bool [h, w], beyond a round border, where no outline is
    real."""
    unknown = np.zeros(masks.shape[1:], dtype=bool) if hidden is None else hidden
    distances = np.empty(masks.shape, dtype=np.float32)
    for row, mask in enumerate(masks):
        inner, outer = mask | unknown, ~mask | unknown
        inside = distance_transform_edt(inner) if not inner.all() else np.full(mask.shape, np.inf)
        outside = distance_transform_edt(outer) if not outer.all() else np.full(mask.shape, np.inf)
        signed = np.where(mask, inside - 0.5, 0.5 - outside)
        limit = float(np.hypot(*mask.shape))
        distances[row] = gaussian_filter(np.clip(signed, -limit, limit), SHAFT_LINES.smooth_px, mode="nearest")
    return Silhouettes(masks & ~unknown, distances, intrinsics, shaft_lines(masks & ~unknown, hidden))


@dataclass(frozen=True, eq=False)
class ShaftLines:
    """The line of a shaft and its tip in each frame's mask, px; NaN where it shows none."""

    points: np.ndarray  # [F, 2] on the line
    directions: np.ndarray  # [F, 2] unit, towards the tip
    tips: np.ndarray  # [F, 2]
    entering_points: np.ndarray  # [F, 2] and [F, 2], as the first two, of the part at the border alone
    entering_directions: np.ndarray

    @property
    def visible(self) -> np.ndarray:
        """Frames that show a shaft, bool [F]."""
        return np.isfinite(self.points[:, 0])

    def take(self, rows: np.ndarray) -> ShaftLines:
        """Return those of some of the frames."""
        return ShaftLines(*(values[rows] for values in vars(self).values()))

    @property
    def entering(self) -> ShaftLines:
        """Lines of the parts at the border: of shafts, whatever bends beyond them."""
        return replace(self, points=self.entering_points, directions=self.entering_directions)


def border_of(size: tuple[int, ...], hidden: np.ndarray | None) -> np.ndarray:
    """Pixels bool [h, w] within `edge_px` of the border of an image of that size, or of what is hidden."""
    border, edge = np.ones(size, dtype=bool), SHAFT_LINES.edge_px
    border[edge:-edge, edge:-edge] = False
    if hidden is not None:
        border |= cv2.dilate(hidden.astype(np.uint8), np.ones((2 * edge + 1,) * 2, np.uint8)).astype(bool)
    return border


def largest_piece(mask: np.ndarray) -> np.ndarray:
    """Return the centres [N, 2] px of the pixels of the largest connected piece of a mask bool [h, w]; none without."""
    pieces, labels, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=8)
    largest = 1 + int(np.argmax(stats[1:, cv2.CC_STAT_AREA])) if pieces > 1 else pieces
    v, u = np.nonzero(labels == largest)
    return np.stack([u, v], -1) + 0.5


def slices_across(
    places: np.ndarray, border: np.ndarray, point: np.ndarray, direction: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Cut a piece's pixels [N, 2] px across a line through `point` along `direction` into slices 1 px long.

    Return numbers [S], middles [S, 2] px and widths [S] px of those that no border, bool [h, w], cuts off.
    """
    along = (places - point) @ direction
    bins = (along - along.min()).astype(int)
    u, v = places.astype(int).T
    count = np.bincount(bins)
    whole = np.flatnonzero((count > 0) & (np.bincount(bins, border[v, u]) == 0))
    middles = np.stack([np.bincount(bins, places[:, k])[whole] for k in (0, 1)], -1) / count[whole, None]
    return whole, middles, count[whole]


def shaft_lines(masks: np.ndarray, hidden: np.ndarray | None = None) -> ShaftLines:
    """Return lines and tips of the largest elongated piece of each mask [F, h, w] that enters at the image's border."""
    count = len(masks)
    points, directions, tips, entries, courses = (np.full((count, 2), np.nan) for _ in range(5))
    border = border_of(masks.shape[1:], hidden)
    for row, mask in enumerate(masks):
        places = largest_piece(mask)
        if len(places) < max(SHAFT_LINES.min_area * mask.size, 1):
            continue
        center = places.mean(0)
        values, vectors = np.linalg.eigh(np.cov((places - center).T))
        if values[1] < SHAFT_LINES.min_elongation**2 * max(values[0], 1e-9):
            continue
        along = (places - center) @ vectors[:, 1]
        u, v = places.astype(int).T
        touching = border[v, u]
        if not touching.any():
            continue
        # the end farther from where it enters is the tip
        sign = -1.0 if np.median(along[touching]) > 0 else 1.0
        direction, along = sign * vectors[:, 1], sign * along
        points[row], directions[row] = center, direction
        end = along > along.max() - 2.0
        if not touching[end].any():
            tips[row] = places[end].mean(0)
        # the middle line of the share of the piece where it enters: what lies beyond may be a wrist that bends, or jaws
        point = center
        for _ in range(SHAFT_LINES.line_rounds):
            slices, middles, _ = slices_across(places, border, point, direction)
            if len(slices):
                middles = middles[slices <= slices[0] + SHAFT_LINES.entering * (slices[-1] - slices[0])]
            if len(middles) < SHAFT_LINES.min_slices:
                break
            weights = np.ones(len(middles))
            for _ in range(SHAFT_LINES.line_rounds):
                point = np.average(middles, 0, weights)
                off = middles - point
                vector = np.linalg.eigh((off * weights[:, None]).T @ off)[1][:, 1]
                direction = vector if vector @ direction >= 0 else -vector
                weights = 1 / (1 + np.square(off @ (-direction[1], direction[0])))
        entries[row], courses[row] = point, direction
    return ShaftLines(points, directions, tips, entries, courses)
