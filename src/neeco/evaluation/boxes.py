"""How well boxes agree: COCO's average precision of boxes drawn about masks."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from scipy import ndimage, sparse
from scipy.sparse.csgraph import maximum_bipartite_matching

COCO_THRESHOLDS = tuple(np.linspace(0.5, 0.95, 10).round(2))
RECALLS = np.linspace(0, 1, 101)


def boxes_of(mask: np.ndarray, components: bool = False) -> np.ndarray:
    """Boxes [n, 4] (x0, y0, x1, y1; px, x1 and y1 exclusive) about a bool mask [H, W].

    One about all its pixels, or with `components` one about each group that touches by side or corner.
    """
    labels = ndimage.label(mask, np.ones((3, 3)))[0] if components else mask.astype(np.uint8)
    found = [(x.start, y.start, x.stop, y.stop) for y, x in ndimage.find_objects(labels)]
    return np.array(found, np.float64).reshape(-1, 4)


def box_ious(boxes: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Intersection over union [n, m] of boxes [n, 4] and [m, 4]."""
    low = np.maximum(boxes[:, None, :2], others[None, :, :2])
    high = np.minimum(boxes[:, None, 2:], others[None, :, 2:])
    both = np.clip(high - low, 0, None).prod(axis=2)
    areas = [np.prod(some[:, 2:] - some[:, :2], axis=1) for some in (boxes, others)]
    return both / (areas[0][:, None] + areas[1][None, :] - both)


def average_precision(
    predicted: Sequence[np.ndarray], truth: Sequence[np.ndarray], thresholds: Sequence[float] = COCO_THRESHOLDS
) -> float:
    """Average precision over recalls 0, .01 … 1, mean over IoU `thresholds` (Lin et al., "Microsoft COCO", 2014).

    predicted, truth: boxes [n, 4] of each image. Masks carry no confidence, so all boxes rank alike: there is one
    operating point, its precision holds up to its recall, and as many boxes are matched as the threshold allows
    (COCO's greedy order would depend on nothing). NaN when no image has a true box.
    """
    boxes, wanted = sum(map(len, predicted)), sum(map(len, truth))
    if not wanted:
        return math.nan
    ious = [box_ious(some, others) for some, others in zip(predicted, truth, strict=True)]
    found = [sum(_matches(table >= threshold) for table in ious) for threshold in thresholds]
    return float(np.mean([hits / boxes * np.mean(hits / wanted >= RECALLS) if hits else 0.0 for hits in found]))


def _matches(fits: np.ndarray) -> int:
    """How many pairs can be made where each row and each column is used once at most."""
    if not fits.any():
        return 0
    return int((maximum_bipartite_matching(sparse.csr_matrix(fits)) >= 0).sum())
