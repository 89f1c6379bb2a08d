"""What passes before the tissue of a scope that moves, with sharp outlines: by motion first, then by colour.

Optical flow tells roughly what moves and bleeds over its outlines; where an instrument is even, it tells nothing. But
instruments have other colours than tissue: those that are seen where something moves, and hardly elsewhere.
"""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np

from neeco.ingest.foreground.colors import color_levels, color_odds, whole_pieces
from neeco.ingest.foreground.motion import ResidualFlow
from neeco.ingest.frames.views import reduced

SUSPECT, SURE, TISSUE = 0.3, 0.7, 0.2  # share of neighbours in time against which a pixel moves: may, does, does not
REACH = np.ones((9, 9), np.uint8)  # px about what may move, in which the instrument is
SMOOTH_PX = 1.5  # over which neighbours vote
ODDS = 1.0  # logarithm of the odds from which a pixel shows an instrument
ROUNDS = 4  # each with the colours of what the one before found
SMALLEST = 0.004  # of the image: what passes is larger
LIKELY, NEAR_PX = 0.5, 1.0  # the same for outlines, once it is known what passes
OF_IT_MOVES = 0.3  # share of a piece that was found to move


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
    colors = color_levels(images)
    inside, outside = moves > SURE, moves <= TISSUE
    for _ in range(ROUNDS):
        odds = color_odds(colors, inside & shown, outside & shown)
        masks = np.stack([
            whole_pieces((odds.smoothed(found, SMOOTH_PX) > ODDS) & may, SMALLEST)
            for found, may in zip(colors, suspect, strict=True)
        ])  # fmt: skip
        inside, outside = masks, ~masks
    # what stood still for a while, and thin ends: of the same colours and in one piece with what moves
    odds = color_odds(colors, inside & shown, outside & shown)
    return np.stack([
        whole_pieces((odds.smoothed(found, NEAR_PX) > LIKELY) & shown, SMALLEST, mask, OF_IT_MOVES)
        for found, mask in zip(colors, masks, strict=True)
    ])  # fmt: skip
