"""The choice of frames: sharp ones that differ, spread over states and views."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import cv2
import numpy as np

from neeco.capture.images import VISIBLE_MM, VISIBLE_RAD, is_repeated

N_NEIGHBOURS = 7  # frames on each side, whose sharpness a frame is compared with
NOISE = 0.004  # mean absolute change of the picture, in [0, 1], that sensor noise alone makes
NOISE_PLACE = 0.06  # the same at one place of a thumbnail
NOISE_MM, NOISE_RAD = 0.3, 0.005  # and of the state, within the tracker's noise
MAX_RANGES = 3  # of frames, named in a note
THUMBNAIL_PX = 64  # px, width


@dataclass(frozen=True)
class DropReason:
    """Why a video frame is not in the capture."""

    why: str
    frame_usable: bool = False  # it could have been in it as well


@dataclass(frozen=True)
class FrameFeatures:
    """Features of every frame [N], computed while the video is read once."""

    sharpness: np.ndarray  # [N]
    thumbnails: np.ndarray  # [N, h, w] grey in [0, 1]
    repeats: np.ndarray  # [N] bool: the picture is that of the frame before


def frame_features(images: Iterable[np.ndarray]) -> FrameFeatures:
    """Return sharpness and thumbnail of every image uint8 [H, W, 3], and whether it repeats the one before."""
    sharpness, thumbnails, repeats = [], [], []
    before: np.ndarray | None = None
    for image in images:
        grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
        # at half size, or sensor noise is taken for detail
        levels = cv2.resize(grey, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
        repeats.append(before is not None and is_repeated(before, levels))
        before, half = levels, levels.astype(np.float32) / 255
        sharpness.append(float(cv2.Laplacian(half, cv2.CV_32F).var()))
        size = (THUMBNAIL_PX, max(1, round(THUMBNAIL_PX * image.shape[0] / image.shape[1])))
        thumbnails.append(cv2.resize(half, size, interpolation=cv2.INTER_AREA))
    return FrameFeatures(np.array(sharpness), np.array(thumbnails), np.array(repeats))


def frozen_frames(features: FrameFeatures, usable: np.ndarray, states: np.ndarray) -> np.ndarray:
    """Return the frames whose picture repeats an earlier one, though the state changed since; see `choose_frames`."""
    source = np.maximum.accumulate(np.where(features.repeats, 0, np.arange(len(states))))
    change = states - states[source]
    moved = (np.linalg.norm(change[:, :3], axis=1) > VISIBLE_MM) | (np.linalg.norm(change[:, 3:], axis=1) > VISIBLE_RAD)
    return np.flatnonzero(moved & usable & usable[source])


def describe_ranges(frames: np.ndarray) -> str:
    """Return increasing frame numbers as `61-89, 104`, the first MAX_RANGES ranges."""
    parts = np.split(frames, np.flatnonzero(np.diff(frames) > 1) + 1)
    words = [f"{part[0]}-{part[-1]}" if len(part) > 1 else f"{part[0]}" for part in parts[:MAX_RANGES]]
    return ", ".join(words) + (", ..." if len(parts) > MAX_RANGES else "")


def choose_frames(
    features: FrameFeatures, usable: np.ndarray, states: np.ndarray, count: int, min_sharpness: float
) -> tuple[np.ndarray, dict[int, DropReason]]:
    """Choose at most `count` sharp frames that differ, spread over states and views; return them, and why not others.

    usable [N] bool: frames with a known state (the others are dropped); states [N, 6+J]: position mm, rotation vector
    rad, joints rad of the instrument; min_sharpness: of the neighbours' median.
    """
    dropped = {int(i): DropReason("no instrument state at its time") for i in np.flatnonzero(~usable)}
    frozen = DropReason("frozen: the state changed, not the picture")
    dropped |= dict.fromkeys(frozen_frames(features, usable, states).tolist(), frozen)
    for i in np.flatnonzero(usable).tolist():
        around = features.sharpness[max(0, i - N_NEIGHBOURS) : i + N_NEIGHBOURS + 1]
        if features.sharpness[i] < min_sharpness * np.median(around):
            share = features.sharpness[i] / np.median(around)
            dropped[i] = DropReason(f"blurred: {share:.0%} of its neighbours' sharpness")
    last: int | None = None
    for i in range(len(usable)):
        if i in dropped:
            continue
        if last is not None and _same(features, states, last, i):
            dropped[i] = DropReason(f"the same as frame {last}: neither picture nor state changed")
        else:
            last = i
    selected = np.array([i for i in range(len(usable)) if i not in dropped], dtype=int)
    if len(selected) > count:
        chosen = selected[_farthest_points(_embedding(features, states)[selected], count)]
        reason = DropReason(f"not among the {count} that cover states and views best", frame_usable=True)
        dropped |= dict.fromkeys((int(i) for i in set(selected) - set(chosen)), reason)
        selected = np.sort(chosen)
    return selected, dropped


def _same(features: FrameFeatures, states: np.ndarray, a: int, b: int) -> bool:
    moved, turned = np.linalg.norm(states[a, :3] - states[b, :3]), np.linalg.norm(states[a, 3:] - states[b, 3:])
    changes = np.abs(features.thumbnails[a] - features.thumbnails[b])
    if not states.any() and changes.max() > NOISE_PLACE:  # no state is known yet, and something small moved
        return False
    return bool(changes.mean() < NOISE and moved < NOISE_MM and turned < NOISE_RAD)


def _embedding(features: FrameFeatures, states: np.ndarray) -> np.ndarray:
    """Return state, main components of the view, and time (SfM needs neighbours) [N, D], each of unit spread."""
    pictures = features.thumbnails.reshape(len(states), -1)
    pictures = pictures - pictures.mean(0)
    basis = np.linalg.svd(pictures[:: max(1, len(pictures) // 400)], full_matrices=False)[2][:3]
    columns = np.concatenate([states, pictures @ basis.T, np.arange(len(states))[:, None]], 1)
    spread = columns.std(0)
    return columns[:, spread > 1e-9] / spread[spread > 1e-9]


def _farthest_points(rows: np.ndarray, count: int) -> np.ndarray:
    """Return the indices of `count` rows [N, D], each the farthest from those before it, first and last in time among
    them."""
    chosen = [0, len(rows) - 1]
    distance = np.minimum(*(np.linalg.norm(rows - rows[i], axis=1) for i in chosen))
    while len(chosen) < count:
        chosen.append(int(distance.argmax()))
        distance = np.minimum(distance, np.linalg.norm(rows - rows[chosen[-1]], axis=1))
    return np.array(chosen[:count])
