"""Overlays of a console: text, icons and bars over the images of a scope that moves, which never move with them."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import cv2
import numpy as np
from scipy import ndimage


@dataclass(frozen=True, kw_only=True)
class OverlaySettings:
    """Thresholds of what is drawn over a scene. Brightness is of 255."""

    min_images: int = 8
    percentiles: tuple[float, float] = (5.0, 95.0)  # of a pixel's brightness; their distance is its spread
    min_motion: float = 12.0  # median spread from which the scene moves; else nothing tells the two apart
    max_spread: float = 8.0  # of what is drawn: compression alone changes it
    min_edge: float = 30.0  # step of the median image among neighbours; what moves has no sharp edges there
    reach: int = 4  # px from such an edge, within which compression makes what is drawn waver; masks are larger by that
    min_sharp: float = 0.6  # share of a region's surroundings that are near one; a shaft's are sharp at one end
    min_region_px: int = 6  # of a stroke or bar
    min_share: float = 2e-4  # of the image; less is a coincidence
    max_share: float = 0.4  # of the image; more is a picture beside the scene, or a scene that stands still


OVERLAY = OverlaySettings()


def find_overlay(images: Iterable[np.ndarray], visible: np.ndarray | None) -> np.ndarray | None:
    """Return the pixels bool [H, W] that are drawn over the scene in all images uint8 [H, W, 3] of a recording; None
    where there are none, or the scene does not move. visible: bool [H, W], the field of view; None: all of it.

    They keep their brightness, and edges nearly all around them are sharp in the median image.
    """
    stack = np.stack([cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) for image in images])
    if len(stack) < OVERLAY.min_images:
        return None
    low, median, high = np.percentile(stack, [OVERLAY.percentiles[0], 50, OVERLAY.percentiles[1]], axis=0)
    field = np.ones(median.shape, bool) if visible is None else visible
    spread = high - low
    if not field.any() or np.median(spread[field]) < OVERLAY.min_motion:
        return None
    still = field & (spread <= OVERLAY.max_spread)
    steps = ndimage.morphological_gradient(median, size=3)  # among a pixel and its neighbours
    sharp = ndimage.maximum_filter(steps, 2 * OVERLAY.reach + 1) > OVERLAY.min_edge
    regions, count = ndimage.label(still, np.ones((3, 3)))
    around = ndimage.grey_dilation(regions, size=3) * ~still  # the region beside a pixel
    pixels = np.bincount(around[field], minlength=count + 1)
    share = np.bincount(around[field & sharp], minlength=count + 1) / np.maximum(pixels, 1)
    large = np.bincount(regions.ravel(), minlength=count + 1) >= OVERLAY.min_region_px
    overlay = still & (large & (share > OVERLAY.min_sharp))[regions]
    if not OVERLAY.min_share <= overlay.mean() <= OVERLAY.max_share:
        return None
    return ndimage.binary_dilation(overlay, iterations=OVERLAY.reach)
