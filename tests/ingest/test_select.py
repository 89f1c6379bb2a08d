"""Blurred and repeated frames are left out; a limit keeps the most different ones."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from neeco.ingest.frames.images import choose_frames, describe_ranges, frame_features, frozen_frames
from neeco.ingest.timing.episodes import CoverageStates


def picture(shift: float, blur: int = 1) -> np.ndarray:
    """A pattern moved by `shift` px, box-blurred."""
    rows, columns = np.mgrid[0:96, 0:128]
    grey = 0.5 + 0.25 * np.sin((columns + shift) / 1.3) + 0.2 * np.sin((rows + columns - shift) / 4.7)
    kernel = np.ones(blur) / blur
    grey = np.apply_along_axis(lambda line: np.convolve(line, kernel, "same"), 1, grey)
    return np.repeat((grey * 255).clip(0, 255).astype(np.uint8)[..., None], 3, 2)


def sliding(rows: np.ndarray) -> CoverageStates:
    """States that move by 2 mm from row to row."""
    positions = np.stack([2.0 * rows, 0 * rows, 0 * rows], 1)
    return CoverageStates(positions, np.tile(np.eye(3).ravel(), (len(rows), 1)), np.zeros((len(rows), 1)))


STATES = sliding(np.arange(30.0))


def test_a_blurred_frame_is_dropped_and_says_so() -> None:
    features = frame_features(picture(4 * i, blur=15 if i == 12 else 1) for i in range(30))
    _, dropped = choose_frames(features, np.ones(30, dtype=bool), STATES, 30, 0.5)
    assert dropped.keys() == {12}
    assert "blurred" in dropped[12].why
    assert not choose_frames(features, np.ones(30, dtype=bool), STATES, 30, 0.01)[1]


def test_a_frame_like_the_one_before_is_dropped_unless_the_instrument_moved() -> None:
    pictures = [picture(4 * min(i, 20)) for i in range(30)]
    for i, image in enumerate(pictures):
        image[10:16, 3 * i : 3 * i + 4] = 255  # the instrument, small
    features = frame_features(pictures)
    still = sliding(np.arange(30.0).clip(max=24))
    selected, _ = choose_frames(features, np.ones(30, dtype=bool), still, 30, 0.5)
    assert selected.tolist() == list(range(25))


def test_frames_of_a_frozen_video_are_dropped_where_the_state_goes_on() -> None:
    generator = np.random.default_rng(0)
    pictures = [picture(4 * (min(i, 12) if i < 20 else i)) for i in range(30)]
    coded = [np.clip(image + (generator.random(image.shape) < 0.05), 0, 255).astype(np.uint8) for image in pictures]
    features = frame_features(coded)
    usable, rows = np.ones(30, dtype=bool), np.arange(30.0)
    resting = sliding(np.where((rows >= 12) & (rows < 18), 12, rows))
    assert frozen_frames(features, usable, STATES).tolist() == list(range(13, 20))
    assert frozen_frames(features, usable, resting).tolist() == [18, 19]
    _, dropped = choose_frames(features, usable, STATES, 30, 0.5)
    assert {dropped[i].why for i in range(13, 20)} == {"frozen: the state changed, not the picture"}
    assert describe_ranges(np.array([3, 13, 14, 15, 19, 25])) == "3, 13-15, 19, ..."


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("instrument", [0, 1])
def test_a_turn_about_any_axis_of_any_instrument_tells_frames_apart(axis, instrument) -> None:
    features = frame_features(picture(0) for _ in range(30))
    turns = Rotation.from_rotvec(0.05 * np.arange(30)[:, None] * np.eye(3)[axis]).as_matrix().reshape(-1, 9)
    rotations = np.tile(np.eye(3).ravel(), (30, 2))
    rotations[:, 9 * instrument : 9 * instrument + 9] = turns
    states = CoverageStates(np.zeros((30, 6)), rotations, np.zeros((30, 0)))
    assert states.changes(np.array([1]), np.array([0]))[1] == pytest.approx(0.05, rel=1e-3)
    usable = np.ones(30, dtype=bool)
    assert frozen_frames(features, usable, states).tolist() == list(range(1, 30))
    moving = frame_features(picture(4 * i) for i in range(30))
    assert {0, 29} <= set(choose_frames(moving, usable, states, 6, 0.5)[0].tolist())


def test_the_second_instrument_moves_in_millimetres() -> None:
    features = frame_features(picture(0) for _ in range(30))
    positions = np.zeros((30, 6))
    positions[:, 4] = 0.2 * np.arange(30)  # 1 mm after 5 frames
    states = CoverageStates(positions, np.tile(np.eye(3).ravel(), (30, 2)), np.zeros((30, 0)))
    assert frozen_frames(features, np.ones(30, dtype=bool), states).min() > 4


def test_a_limit_keeps_extremes_and_both_ends() -> None:
    features = frame_features(picture(4 * i) for i in range(30))
    joints = np.zeros((30, 1))
    joints[17] = 3.0  # a state like no other
    states = replace(STATES, joints=joints)
    selected, _ = choose_frames(features, np.ones(30, dtype=bool), states, 6, 0.5)
    assert len(selected) == 6
    assert {0, 17, 29} <= set(selected.tolist())


def test_frames_without_a_state_are_dropped() -> None:
    features = frame_features(picture(4 * i) for i in range(30))
    usable = np.ones(30, dtype=bool)
    usable[:5] = False
    assert choose_frames(features, usable, STATES, 30, 0.5)[0].min() == 5
