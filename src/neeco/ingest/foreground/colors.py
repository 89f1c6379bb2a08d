"""Colour odds of instrument against tissue: how often a colour is where something moves, and elsewhere."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.ndimage import gaussian_filter

LEVELS = 20  # of each colour
BLUR_LEVELS = 0.7  # of the histogram
MIN_SHARE = 1e-7  # of a colour that never occurs


@dataclass(frozen=True, eq=False)
class ColorOdds:
    """Log odds of every colour inside against outside: float32 [LEVELS**3]."""

    of_color: np.ndarray

    def smoothed(self, found: np.ndarray, px: float) -> np.ndarray:
        """Log odds float32 [h, w] of the colours [h, w] of an image (`color_levels`), averaged over px."""
        return np.asarray(cv2.GaussianBlur(self.of_color[found], (0, 0), px))


def color_levels(images: np.ndarray) -> np.ndarray:
    """Number the colours [...] of images uint8 [..., 3], below LEVELS**3."""
    level = images.astype(np.int64) * LEVELS // 256
    return np.asarray((level[..., 0] * LEVELS + level[..., 1]) * LEVELS + level[..., 2])


def color_odds(colors: np.ndarray, inside: np.ndarray, outside: np.ndarray) -> ColorOdds:
    """Estimate odds from the colours [...] of images and the pixels inside and outside, bool [...]."""
    return ColorOdds(np.log(_shares(colors[inside]) / _shares(colors[outside])).astype(np.float32))


def _shares(colors: np.ndarray) -> np.ndarray:
    """Share of each colour, and of similar ones, in colours [P]."""
    counts = np.bincount(colors, minlength=LEVELS**3).reshape((LEVELS,) * 3).astype(np.float64)
    return np.asarray(gaussian_filter(counts, BLUR_LEVELS) / max(len(colors), 1) + MIN_SHARE).reshape(-1)


def whole_pieces(mask: np.ndarray, smallest: float, moves: np.ndarray | None = None, share: float = 0.0) -> np.ndarray:
    """Return a mask bool [h, w] without specks and holes: pieces larger than a share of the image, of which at least a
    share lies where something `moves`, bool [h, w]."""
    whole = cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    whole = cv2.morphologyEx(whole, cv2.MORPH_CLOSE, np.ones((5, 5), np.uint8))
    count, labels, facts, _ = cv2.connectedComponentsWithStats(whole, connectivity=8)
    keep = facts[:, cv2.CC_STAT_AREA] >= smallest * whole.size
    if moves is not None:
        keep &= np.bincount(labels[moves], minlength=count) >= share * facts[:, cv2.CC_STAT_AREA]
    keep[0] = False  # the rest of the image
    return np.asarray(keep[labels])
