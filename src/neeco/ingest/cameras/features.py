"""Features of images and their matches: SIFT by OpenCV, compared by matrix products, on all cores.

COLMAP's own on the CPU take two to four times as long.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple, TypeVar

import cv2
import numpy as np

from neeco.capture.images import open_image

OCTAVE_LAYERS, EDGE_RATIO, SIGMA = 3, 10, 1.6  # of the scale space, as Lowe 2004 has them
MAX_ANGLE, MAX_RATIO = 0.7, 0.8  # rad between matching descriptors; of the angle to the next similar one

Item = TypeVar("Item")
Result = TypeVar("Result")


class Features(NamedTuple):
    """Features of one image."""

    keypoints: np.ndarray  # float32 [N, 4]: column and row px (pixel centres at +0.5), scale px, orientation rad
    descriptors: np.ndarray  # float32 [N, 128], of length 1: RootSIFT (Arandjelovic and Zisserman 2012)


def find_features(image: Path, mask: Path | None, count: int, min_contrast: float, reduced: bool) -> Features:
    """At most about `count` features of an image file, where a mask is not black. reduced: detected in the image at
    half its size, of which SIFT's finest scale has the double. Raises NeecoError when a file cannot be read."""
    grey, shown = (None if path is None else np.asarray(open_image(path).convert("L")) for path in (image, mask))
    assert grey is not None
    factor = 2 if reduced else 1
    if reduced:
        size = grey.shape[1] // 2, grey.shape[0] // 2
        grey = cv2.resize(grey, size, interpolation=cv2.INTER_AREA)
        shown = None if shown is None else cv2.resize(shown, size, interpolation=cv2.INTER_NEAREST)
    contrast = min_contrast * OCTAVE_LAYERS  # OpenCV divides by them
    # the precise upscaling: the other one shifts features by a quarter of a pixel
    sift = cv2.SIFT_create(count, OCTAVE_LAYERS, contrast, EDGE_RATIO, SIGMA, cv2.CV_32F, True)  # type: ignore[attr-defined]
    found, descriptors = sift.detectAndCompute(grey, shown)
    if not found:
        return Features(np.zeros((0, 4), np.float32), np.zeros((0, 128), np.float32))
    keypoints = np.array([(*point.pt, point.size / 2, np.radians(point.angle)) for point in found], np.float32)
    keypoints[:, :2] = (keypoints[:, :2] + 0.5) * factor
    keypoints[:, 2] *= factor
    return Features(keypoints, np.sqrt(descriptors / np.maximum(descriptors.sum(1, keepdims=True), 1e-9)))


def match_features(one: Features, other: Features) -> np.ndarray:
    """Pairs uint32 [M, 2] of features that are each other's nearest, and clearly nearer than the next."""
    if min(len(one.keypoints), len(other.keypoints)) < 2:
        return np.zeros((0, 2), np.uint32)
    similarity = one.descriptors @ other.descriptors.T
    forward, backward = _clearly_nearest(similarity), _clearly_nearest(similarity.T)
    rows = np.flatnonzero(forward >= 0)
    rows = rows[backward[forward[rows]] == rows]
    return np.stack([rows, forward[rows]], -1).astype(np.uint32)


def _clearly_nearest(similarity: np.ndarray) -> np.ndarray:
    """[N] column of the most similar in each row of [N, M] cosines; -1 where it is far, or the next nearly as near."""
    rows, best = np.arange(len(similarity)), similarity.argmax(1)
    nearest = similarity[rows, best]
    similarity[rows, best] = -1
    angle, next_angle = (np.arccos(cosine.clip(-1, 1)) for cosine in (nearest, similarity.max(1)))
    similarity[rows, best] = nearest
    return np.where((angle < MAX_ANGLE) & (angle < MAX_RATIO * next_angle), best, -1)


def in_threads(function: Callable[[Item], Result], items: Sequence[Item], threads: int) -> Iterator[Result]:
    """Results of a function that leaves Python's lock to others, in order; what has not begun is dropped on failure."""
    pool = ThreadPoolExecutor(threads)
    try:
        yield from pool.map(function, items)
    finally:
        pool.shutdown(cancel_futures=True)
