"""Frames in which an instrument rests count once, so that most of the others show what is behind it."""

from __future__ import annotations

import math

import torch

from neeco.capture.model import Camera, InstrumentState, State
from neeco.evidence.carving import distinct_frames

CAMERA = Camera(torch.eye(4, dtype=torch.float64), 100.0, 100.0, 50.0, 50.0, 100, 100)


def seen(x_mm: float, turn: float = 0.0, joint: float = 0.0) -> State:
    """An instrument 100 mm before the camera."""
    pose = torch.eye(4, dtype=torch.float64)
    pose[:2, :2] = torch.tensor([[math.cos(turn), -math.sin(turn)], [math.sin(turn), math.cos(turn)]])
    pose[:3, 3] = torch.tensor([x_mm, 0.0, 100.0])
    return State({"tool": InstrumentState(pose, {"jaw": joint})})


def moved(shift_mm: float) -> Camera:
    pose = torch.eye(4, dtype=torch.float64)
    pose[0, 3] = shift_mm
    return Camera(pose, 100.0, 100.0, 50.0, 50.0, 100, 100)


def test_of_a_rest_few_frames_stay_and_all_of_a_motion() -> None:
    states = [seen(10.0 * k) for k in range(-4, 5)] + [seen(50.0 + 0.1 * k) for k in range(9)]
    chosen = distinct_frames([(state, CAMERA) for state in states])
    assert chosen[:9] == list(range(9))
    assert 1 <= len(chosen[9:]) <= 3


def test_a_motion_keeps_all_of_its_frames_however_dense() -> None:
    for count in (12, 600):
        states = [seen(-40 + 80 * k / count) for k in range(count)]
        assert distinct_frames([(state, CAMERA) for state in states]) == list(range(count))


def test_a_turn_is_a_motion_and_so_is_that_of_the_camera() -> None:
    turning = [seen(0.0, turn=0.4 * k) for k in range(10)]
    assert len(distinct_frames([(state, CAMERA) for state in turning])) == 10
    assert len(distinct_frames([(seen(0.0), moved(12.0 * k)) for k in range(10)])) == 10


def test_all_frames_of_one_place_leave_at_least_one() -> None:
    assert distinct_frames([(seen(0.0), CAMERA)] * 7) == list(range(7))  # none repeats more than another
    assert distinct_frames([]) == []
    assert distinct_frames([(State({}), CAMERA)] * 3) == [0, 1, 2]
