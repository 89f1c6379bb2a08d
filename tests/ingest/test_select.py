"""Blurred and repeated frames are left out; a limit keeps the most different ones."""

from __future__ import annotations

import numpy as np

from neeco.ingest.frames.images import choose_frames, describe_ranges, frame_features, frozen_frames


def picture(shift: float, blur: int = 1) -> np.ndarray:
    """A pattern moved by `shift` px, box-blurred."""
    rows, columns = np.mgrid[0:96, 0:128]
    grey = 0.5 + 0.25 * np.sin((columns + shift) / 1.3) + 0.2 * np.sin((rows + columns - shift) / 4.7)
    kernel = np.ones(blur) / blur
    grey = np.apply_along_axis(lambda line: np.convolve(line, kernel, "same"), 1, grey)
    return np.repeat((grey * 255).clip(0, 255).astype(np.uint8)[..., None], 3, 2)


STATES = np.zeros((30, 6))
STATES[:, 0] = 2.0 * np.arange(30)


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
    still = STATES.copy()
    still[25:] = still[24]
    selected, _ = choose_frames(features, np.ones(30, dtype=bool), still, 30, 0.5)
    assert selected.tolist() == list(range(25))


def test_frames_of_a_frozen_video_are_dropped_where_the_state_goes_on() -> None:
    generator = np.random.default_rng(0)
    pictures = [picture(4 * (min(i, 12) if i < 20 else i)) for i in range(30)]
    coded = [np.clip(image + (generator.random(image.shape) < 0.05), 0, 255).astype(np.uint8) for image in pictures]
    features = frame_features(coded)
    usable, resting = np.ones(30, dtype=bool), STATES.copy()
    resting[12:18] = resting[12]
    assert frozen_frames(features, usable, STATES).tolist() == list(range(13, 20))
    assert frozen_frames(features, usable, resting).tolist() == [18, 19]
    _, dropped = choose_frames(features, usable, STATES, 30, 0.5)
    assert {dropped[i].why for i in range(13, 20)} == {"frozen: the state changed, not the picture"}
    assert describe_ranges(np.array([3, 13, 14, 15, 19, 25])) == "3, 13-15, 19, ..."


def test_a_limit_keeps_extremes_and_both_ends() -> None:
    features = frame_features(picture(4 * i) for i in range(30))
    states = STATES.copy()
    states[:, 5] = 0.0
    states[17, 5] = 3.0  # a state like no other
    selected, _ = choose_frames(features, np.ones(30, dtype=bool), states, 6, 0.5)
    assert len(selected) == 6
    assert {0, 17, 29} <= set(selected.tolist())


def test_frames_without_a_state_are_dropped() -> None:
    features = frame_features(picture(4 * i) for i in range(30))
    usable = np.ones(30, dtype=bool)
    usable[:5] = False
    assert choose_frames(features, usable, STATES, 30, 0.5)[0].min() == 5
