"""Which frames of a recording are kept, and which of them train, test what was seen, and test what was not."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from neeco.capture.images import is_repeated
from neeco.ingest.recording.model import Splits

NEIGHBOURS = 7  # frames on each side, whose sharpness a frame is compared with
STILL = 0.004  # mean absolute change of the picture, in [0, 1], that sensor noise alone makes
STILL_PLACE = 0.06  # the same at one place of a thumbnail
STILL_MM, STILL_RAD = 0.3, 0.005  # and of the state, within the tracker's noise
FROZEN_MM, FROZEN_RAD = 1.0, 0.03  # by which a state changes visibly while the picture does not
MAX_RANGES = 3  # of frames, named in a note
THUMBNAIL = 64  # px, width
UNSEEN_MARGIN = 3  # video frames on each side of an unseen one chosen by us that no other split may use
MIN_RANGE = 0.1  # rad a joint's readings must span to be split by
TEST_EVERY = 8  # frames, or episodes, of which one tests unless the recording says otherwise
LEFT_OUT = "left out"  # split of a frame too close to an unseen one to train on


@dataclass(frozen=True)
class FrameFeatures:
    """What is kept of every frame while reading the video once."""

    sharpness: np.ndarray  # [N]
    thumbnails: np.ndarray  # [N, h, w] grey in [0, 1]
    repeats: np.ndarray  # [N] bool: the picture is that of the frame before


def frame_features(images: Iterable[np.ndarray]) -> FrameFeatures:
    """Sharpness and a thumbnail of every image [H, W, 3] uint8, and whether it repeats the one before."""
    sharpness, thumbnails, repeats = [], [], []
    before: np.ndarray | None = None
    for image in images:
        grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
        # at half size, or sensor noise is taken for detail
        levels = cv2.resize(grey, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
        repeats.append(before is not None and is_repeated(before, levels))
        before, half = levels, levels.astype(np.float32) / 255
        sharpness.append(float(cv2.Laplacian(half, cv2.CV_32F).var()))
        size = (THUMBNAIL, max(1, round(THUMBNAIL * image.shape[0] / image.shape[1])))
        thumbnails.append(cv2.resize(half, size, interpolation=cv2.INTER_AREA))
    return FrameFeatures(np.array(sharpness), np.array(thumbnails), np.array(repeats))


def frozen_frames(features: FrameFeatures, usable: np.ndarray, states: np.ndarray) -> np.ndarray:
    """Frames whose picture repeats an earlier one, though the state changed since; arguments as of `choose_frames`."""
    source = np.maximum.accumulate(np.where(features.repeats, 0, np.arange(len(states))))
    change = states - states[source]
    moved = (np.linalg.norm(change[:, :3], axis=1) > FROZEN_MM) | (np.linalg.norm(change[:, 3:], axis=1) > FROZEN_RAD)
    return np.flatnonzero(moved & usable & usable[source])


def describe_ranges(frames: np.ndarray) -> str:
    """Increasing frame numbers as `61-89, 104`, the first three ranges."""
    parts = np.split(frames, np.flatnonzero(np.diff(frames) > 1) + 1)
    words = [f"{part[0]}-{part[-1]}" if len(part) > 1 else f"{part[0]}" for part in parts[:MAX_RANGES]]
    return ", ".join(words) + (", ..." if len(parts) > MAX_RANGES else "")


def choose_frames(
    features: FrameFeatures, usable: np.ndarray, states: np.ndarray, count: int | None, min_sharpness: float = 0.5
) -> tuple[np.ndarray, dict[int, str]]:
    """Keep sharp frames that differ, `count` of them at most, spread over states and views: which, and why not others.

    usable [N] bool: frames with a known state (the others are dropped); states [N, 6+J]: position mm, rotation vector
    rad, joints rad of the instrument; min_sharpness: of the neighbours' median.
    """
    dropped = {int(i): "no instrument state at its time" for i in np.flatnonzero(~usable)}
    dropped |= dict.fromkeys(
        frozen_frames(features, usable, states).tolist(), "frozen: the state changed, not the picture"
    )
    for i in np.flatnonzero(usable).tolist():
        around = features.sharpness[max(0, i - NEIGHBOURS) : i + NEIGHBOURS + 1]
        if features.sharpness[i] < min_sharpness * np.median(around):
            dropped[i] = f"blurred: {features.sharpness[i] / np.median(around):.0%} of its neighbours' sharpness"
    last: int | None = None
    for i in range(len(usable)):
        if i in dropped:
            continue
        if last is not None and _same(features, states, last, i):
            dropped[i] = f"the same as frame {last}: neither picture nor state changed"
        else:
            last = i
    selected = np.array([i for i in range(len(usable)) if i not in dropped], dtype=int)
    if count is not None and len(selected) > count:
        chosen = selected[_farthest_points(_embedding(features, states)[selected], count)]
        reason = f"not among the {count} that cover states and views best"
        dropped |= dict.fromkeys((int(i) for i in set(selected) - set(chosen)), reason)
        selected = np.sort(chosen)
    return selected, dropped


def _same(features: FrameFeatures, states: np.ndarray, a: int, b: int) -> bool:
    moved, turned = np.linalg.norm(states[a, :3] - states[b, :3]), np.linalg.norm(states[a, 3:] - states[b, 3:])
    changes = np.abs(features.thumbnails[a] - features.thumbnails[b])
    if not states.any() and changes.max() > STILL_PLACE:  # no state is known yet, and something small moved
        return False
    return bool(changes.mean() < STILL and moved < STILL_MM and turned < STILL_RAD)


def _embedding(features: FrameFeatures, states: np.ndarray) -> np.ndarray:
    """[N, D] state, main components of the view, and time (SfM needs neighbours), each of unit spread."""
    pictures = features.thumbnails.reshape(len(states), -1)
    pictures = pictures - pictures.mean(0)
    basis = np.linalg.svd(pictures[:: max(1, len(pictures) // 400)], full_matrices=False)[2][:3]
    columns = np.concatenate([states, pictures @ basis.T, np.arange(len(states))[:, None]], 1)
    spread = columns.std(0)
    return columns[:, spread > 1e-9] / spread[spread > 1e-9]


def _farthest_points(rows: np.ndarray, count: int) -> np.ndarray:
    """Indices of `count` rows [N, D], each the farthest from those before it, first and last in time among them."""
    chosen = [0, len(rows) - 1]
    distance = np.minimum(*(np.linalg.norm(rows - rows[i], axis=1) for i in chosen))
    while len(chosen) < count:
        chosen.append(int(distance.argmax()))
        distance = np.minimum(distance, np.linalg.norm(rows - rows[chosen[-1]], axis=1))
    return np.array(chosen[:count])


def assign_splits(
    frames: np.ndarray,
    poses: np.ndarray,
    joints: dict[str, np.ndarray],
    rule: Splits,
    episodes: Mapping[str, tuple[int, int]] | None = None,
    everywhere: Mapping[str, np.ndarray] | None = None,
) -> tuple[np.ndarray, str]:
    """Splits [N] (LEFT_OUT: too close to an unseen frame to train on) of video frames [N] (their numbers), and the rule
    in words. poses [N, 4, 4] of the instrument and readings [N] rad per joint: what unseen frames are chosen by;
    episodes: the frames (first, last) of each, where there are several; everywhere: of several tissues the readings
    over all: what is unseen of a joint is so over all."""
    episodes = episodes or {}
    whole = rule.test_episodes
    if episodes and not (whole or rule.test or rule.test_every is not None):
        whole = tuple(episodes)[-max(1, len(episodes) // TEST_EVERY) :]
    every = TEST_EVERY if rule.test_every is None else rule.test_every
    splits = np.full(len(frames), "train", dtype=object)
    if whole:
        splits[_inside(frames, tuple(episodes[name] for name in whole))] = "test"
        words = f"test: {_listed(whole)}"
    elif rule.test:
        splits[_inside(frames, rule.test)] = "test"
        words = "test: video frames " + _ranges(rule.test)
    elif every:
        splits[frames % every == every // 2] = "test"
        words = f"test: video frames whose number leaves {every // 2} when divided by {every}"
    else:
        words = "test: none"
    if rule.unseen_episodes:
        splits[_inside(frames, tuple(episodes[name] for name in rule.unseen_episodes))] = "unseen"
        return splits, f"{words}; unseen: {_listed(rule.unseen_episodes)}"
    if rule.unseen:
        splits[_inside(frames, rule.unseen)] = "unseen"
        return splits, f"{words}; unseen: video frames {_ranges(rule.unseen)}"
    if rule.unseen_fraction == 0:
        return splits, f"{words}; unseen: none"
    unseen, why = _extremes(poses, joints, everywhere or joints, rule.unseen_fraction, rule.unseen_by)
    if not unseen.any():
        return splits, f"{words}; unseen: none, as nothing moves"
    splits[unseen] = "unseen"
    splits[~unseen & (np.abs(frames[:, None] - frames[unseen]).min(1) <= UNSEEN_MARGIN)] = LEFT_OUT
    left_out = f"frames within {UNSEEN_MARGIN} of an unseen one are left out of the capture"
    return splits, f"{words}; unseen: {why}; {left_out}"


def _inside(frames: np.ndarray, ranges: tuple[tuple[int, int], ...]) -> np.ndarray:
    return np.any([(frames >= first) & (frames <= last) for first, last in ranges], axis=0)


def _listed(episodes: tuple[str, ...]) -> str:
    return f"the recording{'s' * (len(episodes) > 1)} {', '.join(episodes)}"


def _ranges(ranges: tuple[tuple[int, int], ...]) -> str:
    return ", ".join(f"{first}-{last}" for first, last in ranges)


def _extremes(
    poses: np.ndarray,
    joints: dict[str, np.ndarray],
    everywhere: Mapping[str, np.ndarray],
    fraction: float,
    by: str | None,
) -> tuple[np.ndarray, str]:
    """The far end of one joint, of the instrument's turn from its mean direction, or half of each."""
    moving = [name for name, values in everywhere.items() if np.ptp(values) > MIN_RANGE]
    joint = by or (moving[0] if moving else None)
    share = fraction if by or joint is None else fraction / 2
    unseen, words = np.zeros(len(poses), dtype=bool), []
    if joint is not None:
        limit = float(np.quantile(everywhere[joint], 1 - share))
        unseen |= joints[joint] > limit
        words.append(f"{joint} above {np.degrees(limit):.0f} deg")
    if by is None:
        turn = Rotation.from_matrix(poses[:, :3, :3])
        away = (turn.mean().inv() * turn).magnitude()
        limit = float(np.quantile(away, 1 - share))
        unseen |= away > limit
        words.append(f"instrument turned more than {np.degrees(limit):.0f} deg from its mean direction")
    return unseen, " or ".join(words)
