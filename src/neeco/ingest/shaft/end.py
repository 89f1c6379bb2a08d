"""Places along a shaft's axis: where it ends and the wrist begins, whose colours differ, and where the tip is.

Neither colour is known. But what enters at the image's border is shaft in most images that show much of the
instrument, and what lies near the tip is not.
"""

from __future__ import annotations

import cv2
import numpy as np

from neeco.geometry.lines import places_nearest_to_rays, unit
from neeco.ingest.foreground.masks import LEVELS, color_odds
from neeco.ingest.shaft.axis import Intrinsics, ShaftAxes

SHAFT_SHARE, HEAD_SHARE = 0.3, 0.3  # of a long mask's length from the border, and from the tip, at first
LONG_SHARE = 0.5  # of the images, those with the longest masks, from which the colours are learned first
EDGE_PX = 2.0  # from the mask's or the image's ends, within which a tip or an end does not count
N_ROUNDS = 4
MARGIN_PX = 3.0  # about the end found, that belongs to neither colour
MAX_ODDS = 3.0  # absolute logarithm, of one place
DARK = 12.0  # of 255, added before logarithms
TINT_RANGES = ((-0.5, 0.9), (-0.3, 0.5), (2.4, 5.6))  # logarithms: red of green, green of blue, lightness
MIN_CONTRAST = 0.5  # difference of the mean odds of shaft and head


def axis_coordinates(axes: ShaftAxes, frame: int, pixels: np.ndarray, intrinsics: Intrinsics) -> np.ndarray:
    """Coordinates [N] mm along a frame's axis, from its point, nearest to the rays of pixels [N, 2]."""
    fx, fy, cx, cy = intrinsics
    rays = unit(np.stack([(pixels[:, 0] - cx) / fx, (pixels[:, 1] - cy) / fy, np.ones(len(pixels))], 1))
    return places_nearest_to_rays(axes.points[frame], axes.directions[frame], rays)


def tips_along(masks: np.ndarray, axes: ShaftAxes, intrinsics: Intrinsics) -> np.ndarray:
    """Coordinates [F] mm along each axis, from its point, of the tip of its mask [F, h, w]; NaN where that is not in
    the image."""
    count, height, width = masks.shape
    tips = np.full(count, np.nan)
    for frame, mask in enumerate(masks):
        pieces, labels, facts, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=8)
        if pieces < 2:
            continue
        v, u = np.nonzero(labels == 1 + int(facts[1:, cv2.CC_STAT_AREA].argmax()))
        hull = cv2.convexHull(np.stack([u, v], 1).astype(np.float32))[:, 0] + 0.5
        along = axis_coordinates(axes, frame, hull, intrinsics)
        tip = hull[along.argmax()]
        if (tip > EDGE_PX).all() and tip[0] < width - EDGE_PX and tip[1] < height - EDGE_PX:
            tips[frame] = along.max()
    return tips


def shaft_ends(images: np.ndarray, masks: np.ndarray, points: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Coordinates [F] px along lines, through `points` [F, 2] px along unit `directions` [F, 2] towards the tip, where
    the shaft ends in the masks [F, h, w] of images uint8 [F, h, w, 3]. NaN where it does not end within the mask, or
    the line is NaN; in all frames, where the colours of shaft and head are similar."""
    assert images.shape[1:3] == masks.shape[1:3]
    frames = [frame for frame in np.flatnonzero(np.isfinite(points[:, 0])) if masks[frame].any()]
    ends = np.full(len(images), np.nan)
    if not frames:
        return ends
    seen = {}
    for frame in frames:
        v, u = np.nonzero(masks[frame])
        along = (np.stack([u, v], 1) + 0.5 - points[frame]) @ directions[frame]
        seen[frame] = _tints(images[frame][v, u]), along, float(along.min()), float(along.max())
    lengths = np.array([seen[frame][3] - seen[frame][2] for frame in frames])
    ranked = np.argsort(-lengths)[: max(1, round(LONG_SHARE * len(frames)))]
    shaft, head = [], []
    for frame in (frames[i] for i in ranked):
        colors, along, first, last = seen[frame]
        shaft.append(colors[along < first + SHAFT_SHARE * (last - first)])
        head.append(colors[along > last - HEAD_SHARE * (last - first)])
    difference = 0.0
    for _ in range(N_ROUNDS):
        colors = np.concatenate([*shaft, *head])
        is_shaft = np.arange(len(colors)) < sum(map(len, shaft))
        odds = np.clip(color_odds(colors, is_shaft, ~is_shaft).of_color, -MAX_ODDS, MAX_ODDS)
        shaft, head = [], []
        for frame in frames:
            own, along, first, last = seen[frame]
            bins = np.floor(along - first).astype(int)
            count = np.bincount(bins)
            mean = np.bincount(bins, odds[own]) / np.maximum(count, 1)
            # the end that explains the colours of all places best
            gained = np.concatenate([[0.0], np.cumsum(mean)])
            best = int(gained.argmax())
            ends[frame] = first + best
            shaft.append(own[along < ends[frame] - MARGIN_PX])
            head.append(own[along > ends[frame] + MARGIN_PX])
        if not any(map(len, shaft)) or not any(map(len, head)):
            return np.full(len(images), np.nan)
        difference = float(odds[np.concatenate(shaft)].mean() - odds[np.concatenate(head)].mean())
    for frame in frames:
        _, _, first, last = seen[frame]
        if not first + EDGE_PX < ends[frame] < last - EDGE_PX:
            ends[frame] = np.nan
    return ends if difference > MIN_CONTRAST else np.full(len(images), np.nan)


def _tints(pixels: np.ndarray) -> np.ndarray:
    """Colours [N] of pixels uint8 [N, 3], numbered as by `color_levels`, but by tints, which separate greys, and
    lightness."""
    red, green, blue = np.log(pixels.astype(np.float64) + DARK).T
    light = (red + green + blue) / 3
    level = [
        np.clip((value - low) / (high - low) * LEVELS, 0, LEVELS - 1).astype(np.int64)
        for value, (low, high) in zip((red - green, green - blue, light), TINT_RANGES, strict=True)
    ]
    return np.asarray((level[0] * LEVELS + level[1]) * LEVELS + level[2])
