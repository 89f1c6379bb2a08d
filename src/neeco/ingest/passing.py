"""What passes before the tissue of a scope that moves, with sharp outlines: by motion first, then by colour.

Optical flow tells roughly what moves and bleeds over its outlines; where an instrument is even, it tells nothing. But
instruments have other colours than tissue: those that are seen where something moves, and hardly elsewhere.
"""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
from scipy.ndimage import gaussian_filter

from neeco.ingest.motion import ResidualFlow
from neeco.ingest.still import reduced

SUSPECT, SURE, TISSUE = 0.3, 0.7, 0.2  # share of neighbours in time against which a pixel moves: may, does, does not
REACH = np.ones((9, 9), np.uint8)  # px about what may move, in which the instrument is
LEVELS = 20  # of each colour, that are told apart
BLUR = 0.7  # levels: colours alike
RARE = 1e-7  # share of a colour that was never seen
SMOOTH_PX = 1.5  # over which neighbours vote
ODDS = 1.0  # logarithm of the odds from which a pixel shows an instrument
ROUNDS = 4  # each with the colours of what the one before found
SMALLEST = 0.004  # of the image: what passes is larger


def passing_masks(
    load: Callable[[int], np.ndarray],
    flow: ResidualFlow,
    rows: np.ndarray,
    moving_px: float,
    visible: np.ndarray | None = None,
) -> np.ndarray:
    """What passes before the tissue, in some rows [R] of `flow.sfm`.

    load(row): image uint8 [H, W, 3]; moving_px: of `ResidualFlow.moving_pixels`; visible: bool [H, W], the field of
    view, where it has a border. Returns bool [R, h, w], of the images `reduced`.
    """
    images = np.stack([reduced(load(row)) for row in rows.tolist()])
    size = images.shape[2:0:-1]
    evidence = np.nan_to_num(flow.moving_pixels(rows, moving_px)).astype(np.float32)
    moves = np.stack([cv2.resize(share, size) for share in evidence])  # [R, h, w]
    suspect = np.stack([cv2.dilate((share > SUSPECT).astype(np.uint8), REACH) > 0 for share in moves])
    shown = np.ones(size[::-1], bool) if visible is None else reduced(visible.astype(np.uint8) * 255) == 255
    suspect &= shown
    level = images.astype(np.int64) * LEVELS // 256
    colors = (level[..., 0] * LEVELS + level[..., 1]) * LEVELS + level[..., 2]
    inside, outside = moves > SURE, moves <= TISSUE
    for _ in range(ROUNDS):
        odds = np.log(_shares(colors[inside & shown]) / _shares(colors[outside & shown])).astype(np.float32)
        masks = np.stack([
            _pieces((cv2.GaussianBlur(odds[found], (0, 0), SMOOTH_PX) > ODDS) & may)
            for found, may in zip(colors, suspect, strict=True)
        ])  # fmt: skip
        inside, outside = masks, ~masks
    return masks


def _shares(colors: np.ndarray) -> np.ndarray:
    """How often each colour is among those [P], and those like it."""
    counts = np.bincount(colors, minlength=LEVELS**3).reshape((LEVELS,) * 3).astype(np.float64)
    return np.asarray(gaussian_filter(counts, BLUR) / max(len(colors), 1) + RARE).reshape(-1)


def _pieces(mask: np.ndarray) -> np.ndarray:
    """A mask bool [h, w] without specks and holes."""
    whole = cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    whole = cv2.morphologyEx(whole, cv2.MORPH_CLOSE, np.ones((5, 5), np.uint8))
    _, labels, facts, _ = cv2.connectedComponentsWithStats(whole, connectivity=8)
    large = facts[:, cv2.CC_STAT_AREA] >= SMALLEST * whole.size
    large[0] = False  # the rest of the image
    return np.asarray(large[labels])
