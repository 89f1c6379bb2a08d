"""The split of frames into training, test (seen states) and unseen states."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from scipy.spatial.transform import Rotation

from neeco.base.errors import NeecoError
from neeco.ingest.recording.model import Splits
from neeco.ingest.timing.episodes import Episodes, States

UNSEEN_MARGIN = 3  # video frames on each side of an unseen one chosen by us that no other split may use
MIN_RANGE = 0.1  # rad that a joint's readings must span to be split by
TEST_EVERY = 8  # frames, or episodes, of which one tests unless the recording states otherwise
LEFT_OUT = "left out"  # split of a frame too close to an unseen one to train on


def split_frames(data: Episodes, frames: np.ndarray, states: States, usable: np.ndarray) -> tuple[np.ndarray, str]:
    """Split video frames [M] by the first tracked instrument's states where these are `usable` [M]; LEFT_OUT elsewhere.

    Return the splits and the rule in words. Raises NeecoError.
    """
    poses, joints = next(iter(states.values()), (np.tile(np.eye(4), (len(frames), 1, 1)), {}))
    where, rule = data.recording.path, data.recording.splits
    by = rule.unseen_by if rule else None
    if by is not None and by not in joints:  # another instrument's
        owner = next((values for _, values in states.values() if by in values), None)
        if owner is None:
            raise NeecoError(f"{where}: splits.unseen_by: {by!r} belongs to an instrument without poses; name another")
        joints = owner
    rule = rule or (Splits() if states else Splits(unseen_fraction=0.0))
    readings = {joint: values[usable] for joint, values in joints.items()}
    assigned, words = assign_splits(frames[usable], poses[usable], readings, rule, data.ranges)
    if "train" not in assigned:
        raise NeecoError(f"{where}: splits: leave no frame to train on ({words}); change them")
    for name in rule.test_episodes + rule.unseen_episodes:
        first, last = data.ranges[name]
        if not ((frames[usable] >= first) & (frames[usable] <= last)).any():
            data.notes.add(f"splits: no frame of the episode {name} is in the capture")
    for kind, ranges in (("test", rule.test), ("unseen", rule.unseen)):
        if ranges and kind not in assigned:
            data.notes.add(
                f"splits.{kind}: no frame of the capture lies in the ranges given (the video has "
                f"{len(data.times)} frames)"
            )
    splits = np.full(len(frames), LEFT_OUT, dtype=object)
    splits[usable] = assigned
    return splits, words


def assign_splits(
    frames: np.ndarray,
    poses: np.ndarray,
    joints: Mapping[str, np.ndarray],
    rule: Splits,
    episodes: Mapping[str, tuple[int, int]] | None = None,
) -> tuple[np.ndarray, str]:
    """Split video frames [N], given by number; return the splits [N] and the rule in words.

    Unseen frames are chosen by poses [N, 4, 4] of the instrument and readings [N] rad by joint. A frame too close to
    one of them is LEFT_OUT. episodes: the frames (first, last) of each of several.
    """
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
    unseen, why = _extremes(poses, joints, rule.unseen_fraction, rule.unseen_by)
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
    poses: np.ndarray, joints: Mapping[str, np.ndarray], fraction: float, by: str | None
) -> tuple[np.ndarray, str]:
    """Return the frames [N] at the far end of one joint, of the instrument's turn from its mean direction, or half of
    each; and the rule in words."""
    moving = [name for name, values in joints.items() if np.ptp(values) > MIN_RANGE]
    joint = by or (moving[0] if moving else None)
    share = fraction if by or joint is None else fraction / 2
    unseen, words = np.zeros(len(poses), dtype=bool), []
    if joint is not None:
        limit = float(np.quantile(joints[joint], 1 - share))
        unseen |= joints[joint] > limit
        words.append(f"{joint} above {np.degrees(limit):.0f} deg")
    if by is None:
        turn = Rotation.from_matrix(poses[:, :3, :3])
        away = (turn.mean().inv() * turn).magnitude()
        limit = float(np.quantile(away, 1 - share))
        unseen |= away > limit
        words.append(f"instrument turned more than {np.degrees(limit):.0f} deg from its mean direction")
    return unseen, " or ".join(words)
