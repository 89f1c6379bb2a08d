"""Which frames train, which test what was seen, and which test what was not."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from neeco.ingest.recording import Splits

TEST_EVERY = 8
UNSEEN_FRACTION = 0.15  # of all frames, kept for the extremes of the state range
GUARD = 3  # video frames on each side of an unseen one chosen by us that no other split may use
MOVES = 0.1  # rad a joint's readings must span to be split by
LEFT_OUT = "left out"


@dataclass(frozen=True)
class Assigned:
    """One split per frame (or LEFT_OUT: too close to an unseen frame to train on), and the rule in words."""

    names: tuple[str, ...]
    rule: str


def assign_splits(
    frames: np.ndarray, poses: np.ndarray, joints: dict[str, np.ndarray], rule: Splits | None = None
) -> Assigned:
    """Splits of video frames [N] (their numbers) with instrument poses [N, 4, 4] and readings [N] rad per joint."""
    rule = rule or Splits()
    every = TEST_EVERY if rule.test_every is None else rule.test_every
    splits = np.full(len(frames), "train", dtype=object)
    if rule.test:
        splits[_inside(frames, rule.test)] = "test"
        words = "test: video frames " + _ranges(rule.test)
    elif every:
        splits[frames % every == every // 2] = "test"
        words = f"test: video frames whose number leaves {every // 2} when divided by {every}"
    else:
        words = "test: none"
    if rule.unseen:
        splits[_inside(frames, rule.unseen)] = "unseen"
        return Assigned(tuple(splits), f"{words}; unseen: video frames {_ranges(rule.unseen)}")
    fraction = UNSEEN_FRACTION if rule.unseen_fraction is None else rule.unseen_fraction
    if fraction == 0:
        return Assigned(tuple(splits), f"{words}; unseen: none")
    unseen, why = _extremes(poses, joints, fraction, rule.unseen_by)
    if not unseen.any():
        return Assigned(tuple(splits), f"{words}; unseen: none, as nothing moves")
    splits[unseen] = "unseen"
    splits[~unseen & (np.abs(frames[:, None] - frames[unseen]).min(1) <= GUARD)] = LEFT_OUT
    return Assigned(
        tuple(splits), f"{words}; unseen: {why}; frames within {GUARD} of an unseen one are left out of the capture"
    )


def _inside(frames: np.ndarray, ranges: tuple[tuple[int, int], ...]) -> np.ndarray:
    return np.any([(frames >= first) & (frames <= last) for first, last in ranges], axis=0)


def _ranges(ranges: tuple[tuple[int, int], ...]) -> str:
    return ", ".join(f"{first}-{last}" for first, last in ranges)


def _extremes(
    poses: np.ndarray, joints: dict[str, np.ndarray], fraction: float, by: str | None
) -> tuple[np.ndarray, str]:
    """The far end of one joint, of the instrument's turn from its mean direction, or half of each."""
    moving = [name for name, values in joints.items() if np.ptp(values) > MOVES]
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
