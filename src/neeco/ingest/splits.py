"""Which frames of a recording are learned from and which test: as the recording says, with what it costs in words."""

from __future__ import annotations

import numpy as np

from neeco.errors import NeecoError
from neeco.ingest.frames.selection import LEFT_OUT, assign_splits
from neeco.ingest.recording.model import Splits
from neeco.ingest.timing.episodes import Episodes
from neeco.ingest.timing.synchronized import States


def split_frames(
    data: Episodes,
    frames: np.ndarray,
    states: States,
    usable: np.ndarray,
    everywhere: dict[str, dict[str, np.ndarray]] | None,
) -> tuple[np.ndarray, str]:
    """Splits [M] of video frames [M] by the first tracked instrument's states, where these are `usable` [M] (LEFT_OUT
    elsewhere), and the rule in words; everywhere: readings by instrument and joint, of all of several worlds. Raises
    NeecoError."""
    poses, joints = next(iter(states.values()), (np.tile(np.eye(4), (len(frames), 1, 1)), {}))
    where, rule = data.recording.path, data.recording.splits
    known = next(iter((everywhere or {}).values()), {})
    by = rule.unseen_by if rule else None
    if by is not None and by not in joints:  # another instrument's
        owner = next((values for _, values in states.values() if by in values), None)
        if owner is None:
            raise NeecoError(f"{where}: splits.unseen_by: {by!r} belongs to an instrument without poses; name another")
        joints = owner
        known = next((values for values in (everywhere or {}).values() if by in values), {})
    rule = rule or (Splits() if states else Splits(unseen_fraction=0.0))
    readings = {joint: values[usable] for joint, values in joints.items()}
    assigned, words = assign_splits(frames[usable], poses[usable], readings, rule, data.ranges, known)
    if "train" not in assigned:
        raise NeecoError(f"{where}: splits: leave no frame to train on ({words}); change them")
    for name in rule.test_episodes + rule.unseen_episodes:
        first, last = data.ranges[name]
        if not ((frames[usable] >= first) & (frames[usable] <= last)).any():
            data.note(f"splits: no frame of the episode {name} is in the capture")
    for kind, ranges in (("test", rule.test), ("unseen", rule.unseen)):
        if ranges and kind not in assigned:
            data.note(
                f"splits.{kind}: no frame of the capture lies in the ranges given (the video has "
                f"{len(data.times)} frames)"
            )
    splits = np.full(len(frames), LEFT_OUT, dtype=object)
    splits[usable] = assigned
    return splits, words
