"""What the share of instrument says about pixels that a mask calls all instrument or all tissue."""

from __future__ import annotations

import cv2
import numpy as np

from neeco.labels.composited import CLEAR_SHARES

# Of the image's diagonal: 3 px of 320 x 256. Measured on two rendered captures: without it the band has 36 and 66% more
# pixels, nearly all of them rightly labelled (the instrument's shadow on the tissue, mostly).
REACH = 0.008
TOUCHING = np.ones((3, 3), np.uint8)  # at a corner, too: else the band of a slanted border is thinner than a pixel


def uncertain_edge(share: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """bool [H, W]: the pixels at the edge of a mask (bool [H, W]) that may well be on its other side.

    Those that touch the border from either side, since a border may be a pixel off even where the share of instrument
    ([H, W] in [0, 1]) jumps; and those within REACH of them whose share is between CLEAR_SHARES. The image's own border
    is none.
    """
    pixels = mask.astype(np.uint8)
    border = cv2.dilate(pixels, TOUCHING) != cv2.erode(pixels, TOUCHING)
    if not border.any():
        return border
    unclear = (share > CLEAR_SHARES[0]) & (share < CLEAR_SHARES[1])
    return border | (unclear & (_distance_to(border) <= REACH * np.hypot(*mask.shape)))


def without_pieces(share: np.ndarray, kept: np.ndarray, dropped: np.ndarray) -> np.ndarray:
    """The share of instrument [H, W] with 0 in a mask's dropped pieces and in what fades around them.

    kept, dropped: bool [H, W], together the mask. A pixel of neither that is not clearly instrument goes with the piece
    nearest to it.
    """
    if not dropped.any():
        return share
    fading = ~kept & (share < CLEAR_SHARES[1]) & (_distance_to(dropped) < _distance_to(kept))
    return np.where(dropped | fading, np.float32(0), share)


def _distance_to(pixels: np.ndarray) -> np.ndarray:
    """[H, W] px, between centres, to the nearest of the pixels (bool [H, W], at least one)."""
    return cv2.distanceTransform((~pixels).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
