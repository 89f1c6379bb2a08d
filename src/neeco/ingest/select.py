"""Which frames of a recording are worth keeping."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import cv2
import numpy as np

BLUR = 0.5  # of the neighbours' sharpness: less is a blurred frame
NEIGHBOURS = 7  # frames on each side
STILL = 0.004  # mean absolute change of the picture, in [0, 1], that sensor noise alone makes
STILL_MM, STILL_RAD = 0.3, 0.005  # and of the state, within the tracker's noise
THUMBNAIL = 64  # px, width


@dataclass(frozen=True)
class Look:
    """What is kept of every frame while reading the video once."""

    sharpness: np.ndarray  # [N]
    thumbnails: np.ndarray  # [N, h, w] grey in [0, 1]


@dataclass(frozen=True)
class Selection:
    """Frames kept, and why the others were not."""

    kept: np.ndarray  # indices
    dropped: tuple[tuple[int, str], ...]


def look_over(images: Iterable[np.ndarray]) -> Look:
    """Sharpness and a thumbnail of every image [H, W, 3] uint8."""
    sharpness, thumbnails = [], []
    for image in images:
        grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
        # at half size, or sensor noise is taken for detail
        half = cv2.resize(grey, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA).astype(np.float32) / 255
        sharpness.append(float(cv2.Laplacian(half, cv2.CV_32F).var()))
        size = (THUMBNAIL, max(1, round(THUMBNAIL * image.shape[0] / image.shape[1])))
        thumbnails.append(cv2.resize(half, size, interpolation=cv2.INTER_AREA))
    return Look(np.array(sharpness), np.array(thumbnails))


def choose_frames(look: Look, usable: np.ndarray, states: np.ndarray, count: int | None) -> Selection:
    """Keep sharp frames that differ, `count` of them at most, spread over states and views.

    usable [N] bool: frames with a known state (the others are dropped); states [N, 6+J]: position mm, rotation vector
    rad, joints rad of the instrument.
    """
    dropped = {int(i): "no instrument state at its time" for i in np.flatnonzero(~usable)}
    for i in np.flatnonzero(usable).tolist():
        around = look.sharpness[max(0, i - NEIGHBOURS) : i + NEIGHBOURS + 1]
        if look.sharpness[i] < BLUR * np.median(around):
            dropped[i] = f"blurred: {look.sharpness[i] / np.median(around):.0%} of its neighbours' sharpness"
    last: int | None = None
    for i in range(len(usable)):
        if i in dropped:
            continue
        if last is not None and _same(look, states, last, i):
            dropped[i] = f"the same as frame {last}: neither picture nor state changed"
        else:
            last = i
    kept = np.array([i for i in range(len(usable)) if i not in dropped], dtype=int)
    if count is not None and len(kept) > count:
        chosen = kept[_spread(_features(look, states)[kept], count)]
        dropped |= {int(i): f"not among the {count} that cover states and views best" for i in set(kept) - set(chosen)}
        kept = np.sort(chosen)
    return Selection(kept, tuple(sorted(dropped.items())))


def _same(look: Look, states: np.ndarray, a: int, b: int) -> bool:
    moved, turned = np.linalg.norm(states[a, :3] - states[b, :3]), np.linalg.norm(states[a, 3:] - states[b, 3:])
    change = np.abs(look.thumbnails[a] - look.thumbnails[b]).mean()
    return bool(change < STILL and moved < STILL_MM and turned < STILL_RAD)


def _features(look: Look, states: np.ndarray) -> np.ndarray:
    """[N, D] state, main components of the view, and time (SfM needs neighbours), each of unit spread."""
    pictures = look.thumbnails.reshape(len(states), -1)
    pictures = pictures - pictures.mean(0)
    basis = np.linalg.svd(pictures[:: max(1, len(pictures) // 400)], full_matrices=False)[2][:3]
    columns = np.concatenate([states, pictures @ basis.T, np.arange(len(states))[:, None]], 1)
    spread = columns.std(0)
    return columns[:, spread > 1e-9] / spread[spread > 1e-9]


def _spread(features: np.ndarray, count: int) -> np.ndarray:
    """Indices of `count` rows [N, D], each the farthest from those before it, first and last in time among them."""
    chosen = [0, len(features) - 1]
    distance = np.minimum(*(np.linalg.norm(features - features[i], axis=1) for i in chosen))
    while len(chosen) < count:
        chosen.append(int(distance.argmax()))
        distance = np.minimum(distance, np.linalg.norm(features - features[chosen[-1]], axis=1))
    return np.array(chosen[:count])
