"""Whether a scope stands still, from features that stay in place."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import cv2
import numpy as np

from neeco.capture.model import evenly_spaced
from neeco.ingest.frames.views import reduced

N_FRAMES = 24  # spread over the recording, that are compared with each other
N_CELLS = 20  # across an image, with a feature each
MIN_TEXTURE = 2e-5  # of a feature: the lesser eigenvalue of its slopes' covariance, of a white of 1
MIN_FEATURES = 30
TRACKING: dict[str, Any] = {"winSize": (15, 15), "maxLevel": 1, "flags": cv2.OPTFLOW_USE_INITIAL_FLOW}
IN_PLACE = 0.0125  # share of the image's width within which a feature is in place (tissue breathes)
MAX_RETURN_PX = 1.0  # error of a feature that is tracked there and back
STILL_SHARE = 0.2  # of the features, in place in frames of a still scope; the others move or breathe
STILL_PAIRS = 0.85  # share of the pairs of frames, in which they are


def stands_still(load: Callable[[int], np.ndarray], count: int) -> bool:
    """Whether a scope stood still while it took `count` images (load: one of them, uint8 [H, W, 3]): most features that
    are not on something that moves stay in place in the other frames."""
    rows = evenly_spaced(count, N_FRAMES)
    grey = [_even_light(cv2.cvtColor(reduced(load(row)), cv2.COLOR_RGB2GRAY)) for row in rows]
    stay = []
    for step in {1, len(grey) // 3, len(grey) // 2, 2 * len(grey) // 3} - {0}:
        stay += [_share_in_place(first, second) for first, second in zip(grey, grey[step:], strict=False)]
    shares = np.array([share for share in stay if share is not None])
    return len(shares) > 0 and float(np.mean(shares > STILL_SHARE)) > STILL_PAIRS


def same_place(first: np.ndarray, second: np.ndarray) -> float | None:
    """Share of the features of a background uint8 [H, W, 3] that are in place in a second; None: it has too few."""
    grey = [_even_light(cv2.cvtColor(reduced(image), cv2.COLOR_RGB2GRAY)) for image in (first, second)]
    return _share_in_place(*grey)


def _share_in_place(first: np.ndarray, second: np.ndarray) -> float | None:
    """`same_place` of equalised images [H, W]."""
    found = _features(first)
    if len(found) < MIN_FEATURES:
        return None
    there, seen, _ = cv2.calcOpticalFlowPyrLK(first, second, found, found.copy(), **TRACKING)
    back, seen_back, _ = cv2.calcOpticalFlowPyrLK(second, first, there, there.copy(), **TRACKING)
    returns = np.linalg.norm(back - found, axis=-1)[:, 0] < MAX_RETURN_PX
    near = np.linalg.norm(there - found, axis=-1)[:, 0] < IN_PLACE * first.shape[1]
    return float((returns & near & (seen[:, 0] > 0) & (seen_back[:, 0] > 0)).mean())


def _even_light(grey: np.ndarray) -> np.ndarray:
    """Return an image uint8 [H, W] relative to its local brightness, which exposure and shadows change."""
    around = cv2.GaussianBlur(grey.astype(np.float32), (0, 0), grey.shape[1] / N_CELLS)
    return np.clip(128.0 * grey / np.maximum(around, 8), 0, 255).astype(np.uint8)


def _features(grey: np.ndarray) -> np.ndarray:
    """The best feature float32 [K, 1, 2] px of every cell of an image uint8 [H, W] that has one. The best of the whole
    image would be highlights, which come and go."""
    strength = cv2.cornerMinEigenVal(grey, 7)
    side = grey.shape[1] // N_CELLS
    places = []
    for top in range(side // 2, grey.shape[0] - side, side):
        for left in range(side // 2, grey.shape[1] - side, side):
            cell = strength[top : top + side, left : left + side]
            if cell.max() > MIN_TEXTURE:
                row, column = np.unravel_index(cell.argmax(), cell.shape)
                places.append((left + column, top + row))
    return np.array(places, np.float32).reshape(-1, 1, 2)
