"""Which joints may move parts: those whose readings the pose does not already tell."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from neeco.base.errors import NeecoError
from neeco.capture.model import Camera, Frame, Instrument, InstrumentState, State
from neeco.geometry.rotations import rigid_from_vector
from neeco.methods.kinematic.hinges import hinge_joints
from neeco.training.config import TrainConfig
from neeco.training.initial import moving_joints

ARM = Instrument("arm", {"insertion": None, "jaw": (0.0, 1.0), "stuck": None})
CAMERA = Camera(torch.eye(4, dtype=torch.float64), 50.0, 50.0, 20.0, 16.0, 40, 32)


def frames(count: int = 40, cameras: int = 1) -> tuple[Frame, ...]:
    """An arm whose insertion is its tip's depth, whose jaw is free and whose third joint never moves."""
    rng = np.random.default_rng(2)
    taken = []
    for k in range(count):
        vector = torch.from_numpy(np.concatenate([rng.normal(0, 0.3, 3), rng.normal(0, 10, 3)]))
        pose = rigid_from_vector(vector)
        joints = {"insertion": 0.01 * float(pose[2, 3]) + 0.4, "jaw": float(rng.uniform()), "stuck": 0.7}
        state = State({"arm": InstrumentState(pose, joints)}, 0.04 * k)
        taken += [Frame(Path(f"{k}_{c}.png"), CAMERA, state, "train") for c in range(cameras)]
    return tuple(taken)


@pytest.mark.parametrize("cameras", [1, 6])
def test_a_joint_that_follows_from_the_pose_moves_no_part_and_is_named(cameras: int) -> None:
    told: list[str] = []
    assert moving_joints(ARM, frames(cameras=cameras), TrainConfig(), told.append) == ("jaw", "stuck")
    assert told == ["arm: joint insertion follows from the pose; it moves no part of its own"]


def test_a_jaw_that_moves_smoothly_for_five_seconds_does_not_follow_from_the_pose_by_chance() -> None:
    """Fifty frames of it have as few independent values as a pose has numbers."""
    rng = np.random.default_rng(0)
    phases, rates = rng.uniform(0, 6, 7), rng.uniform(0.5, 3, 7)
    taken = []
    for time in np.arange(50) / 10:
        motion = np.sin(rates * time + phases)
        pose = rigid_from_vector(torch.from_numpy(motion[:6] * [0.4, 0.4, 1.5, 15, 15, 10]))
        state = State({"arm": InstrumentState(pose, {"jaw": 0.4 + 0.3 * float(motion[6])})}, float(time))
        taken.append(Frame(Path(f"{time}.png"), CAMERA, state, "train"))
    told: list[str] = []
    assert moving_joints(Instrument("arm", {"jaw": None}), tuple(taken), TrainConfig(), told.append) == ("jaw",)
    assert told == []


def test_joints_that_are_asked_for_are_taken_as_given() -> None:
    told: list[str] = []
    assert moving_joints(ARM, frames(), TrainConfig(joints=("insertion",)), told.append) == ("insertion",)
    assert told == []


def test_a_joint_that_is_not_there_is_refused_by_name() -> None:
    with pytest.raises(NeecoError, match="--joints: arm has no joint 'jow'; it has insertion, jaw, stuck"):
        moving_joints(ARM, frames(), TrainConfig(joints=("jow",)), print)


def test_prismatic_joints_move_no_hinge() -> None:
    wristed = Instrument("arm", {"insertion": None, "jaw": (0.0, 1.0), "stuck": None, "rod_mm": None})
    told: list[str] = []
    assert hinge_joints(wristed, ("insertion", "jaw", "rod_mm"), told.append) == ("insertion", "jaw")
    assert "rod_mm is prismatic" in told[0]
