"""Frames are split so that tests are honest."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from neeco.ingest.pipeline import LEFT_OUT, SPLITS, assign_splits
from neeco.ingest.recording.model import Splits

FRAMES = np.arange(200)
OPENING = np.concatenate([np.linspace(0, 0.8, 150), np.linspace(0.8, 1.4, 50)])
POSES = np.tile(np.eye(4), (200, 1, 1))
POSES[:, :3, :3] = Rotation.from_rotvec(np.outer(0.3 * np.sin(FRAMES / 9), [0, 0, 1])).as_matrix()


def test_the_widest_openings_are_unseen_and_training_never_comes_near_them() -> None:
    names, rule = assign_splits(FRAMES, POSES, {"jaw_angle": OPENING}, Splits(unseen_by="jaw_angle"))
    assert (names == "unseen").sum() == 30
    assert OPENING[names == "unseen"].min() > OPENING[names == "train"].max()
    assert FRAMES[names == "unseen"].min() - FRAMES[names == "train"].max() > SPLITS.unseen_margin
    assert "jaw_angle above" in rule


def test_test_frames_lie_between_training_frames() -> None:
    names, _ = assign_splits(FRAMES, POSES, {}, Splits(unseen_fraction=0.0))
    assert (FRAMES[names == "test"] % 8 == 4).all()
    assert set(names) == {"train", "test"}


def test_given_ranges_are_taken_as_they_are() -> None:
    names, rule = assign_splits(FRAMES, POSES, {"jaw_angle": OPENING}, Splits(unseen=((170, 199),)))
    assert (names[170:] == "unseen").all()
    assert LEFT_OUT not in names
    assert "170-199" in rule


def test_half_of_the_unseen_frames_are_turned_far() -> None:
    names, _ = assign_splits(FRAMES, POSES, {"jaw_angle": OPENING}, Splits())
    away = Rotation.from_matrix(POSES[:, :3, :3]).magnitude()
    assert away[names == "unseen"].max() > away[names == "train"].max() * 0.95
    assert (names == "unseen").sum() >= 15
