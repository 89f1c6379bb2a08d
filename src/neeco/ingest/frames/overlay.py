"""Console overlays: text, icons and bars over the images of a moving scope, which never move with the scene."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import cv2
import numpy as np
from scipy import ndimage


@dataclass(frozen=True, kw_only=True)
class OverlaySettings:
    """Thresholds for overlays. Brightness is of 255."""

    min_images: int = 8
    percentiles: tuple[float, float] = (5.0, 95.0)  # percentiles of a pixel's brightness whose difference is its spread
    min_motion: float = 12.0  # minimum median spread of a moving scene
    max_spread: float = 8.0  # maximum spread of an overlay, by compression alone
    min_edge: float = 30.0  # minimum step of the median image; moving content has no sharp edges there
    reach: int = 4  # px of compression artefacts around such an edge, by which masks are dilated
    min_sharp: float = 0.6  # minimum share of a region's boundary with a sharp edge; a shaft's is sharp at one end
    min_region_px: int = 6  # minimum size of a stroke or bar
    min_share: float = 2e-4  # of the image; smaller ones are coincidences
    max_share: float = 0.4  # of the image; larger ones are side panels, or a still scene


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
