"""Errors of new states, predicted from those that training found."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch import Tensor

from neeco.capture.kinematics import REVOLUTE, KinematicTree, Link
from neeco.capture.model import Frame, Instrument, InstrumentState, State
from neeco.geometry.camera import Camera
from neeco.geometry.rotations import rigid_from_vector
from neeco.scene.state_corrections import StateCorrections
from neeco.states.prediction import Prediction, predict_corrections
from neeco.states.refinement import RefineConfig, Refinement

CPU = torch.device("cpu")
CAMERA = Camera(torch.eye(4, dtype=torch.float64), 60.0, 60.0, 32.0, 24.0, 64, 48)
JAWS = KinematicTree((Link("shaft"), Link("jaw", "shaft", REVOLUTE, value={"jaw": 1.0})))
ROD = Instrument("rod", {"jaw": (0.0, 1.0)}, JAWS)


def state_at(place: float, time: float) -> State:
    """The rod along its only path: it turns while it moves by 30 mm, and opens."""
    pose = rigid_from_vector(torch.tensor([0, 0, place, 30 * place, 0, 0], dtype=torch.float64))
    return State({"rod": InstrumentState(pose, {"jaw": place})}, time)


def there_and_back(count: int = 40) -> tuple[Frame, ...]:
    places = [0.5 - 0.5 * math.cos(2 * math.pi * k / count) for k in range(count)]
    return tuple(Frame(Path(f"{k}.png"), CAMERA, state_at(place, 0.1 * k), "train") for k, place in enumerate(places))


def error_at(place: float) -> Tensor:
    """Of a pose in its own frame, rad and mm, zero on average."""
    return torch.tensor([0.02 * (place - 0.5), 0, 0, 0, 2.0 * (place - 0.5), 0])


def learned(frames: tuple[Frame, ...], poses: Tensor) -> tuple[StateCorrections, dict[str, Prediction], Refinement]:
    """What is predicted where training found these corrections [F, 6] of the rod's poses."""
    refinement = Refinement(RefineConfig(), frames, (ROD,), CPU)
    refinement.poses[:, 0] = poses
    refinement.frame_steps += 1
    corrections = StateCorrections((ROD,), CPU)
    return corrections, predict_corrections(corrections, refinement, frames), refinement


def test_an_error_that_depends_on_the_state_is_corrected_in_new_states() -> None:
    frames = there_and_back()
    places = [frame.state.instruments["rod"].joints["jaw"] for frame in frames]
    corrections, found, refinement = learned(frames, torch.stack([error_at(place) for place in places]))
    assert found["rod"].applied
    assert found["rod"].explained > 0.9
    assert refinement.poses.abs().max() < 0.2  # what is predicted is not corrected twice
    for place in (0.1, 0.33, 0.8):
        given = state_at(place, 99.0)
        moved = corrections.corrected(given).instruments["rod"].pose
        expected = given.instruments["rod"].pose.float() @ rigid_from_vector(error_at(place))
        assert (moved - expected)[:3, 3].norm() < 0.15
        assert (moved - expected)[:3, :3].norm() < 2e-3
    far = state_at(0.5, 0.0)
    far.instruments["rod"].pose[2, 3] = 500.0  # nothing is known there
    assert torch.allclose(corrections.corrected(far).instruments["rod"].pose, far.instruments["rod"].pose.float())


def test_a_state_that_was_wrong_altogether_tells_nothing_of_others() -> None:
    frames = there_and_back()
    generator = torch.Generator().manual_seed(0)
    poses = 0.01 * torch.randn(len(frames), 6, generator=generator)
    poses[::8, 3:] += 20.0  # as states of another moment were corrected
    refinement = Refinement(RefineConfig(), frames, (ROD,), CPU)
    refinement.poses[:, 0] = poses
    refinement.frame_steps += 1
    refinement.fitted[::8] = True
    refinement.center()
    assert (refinement.poses[1::8, 0] - poses[1::8]).abs().max() < 0.1
    corrections = StateCorrections((ROD,), CPU)
    assert not predict_corrections(corrections, refinement, frames)["rod"].applied


@pytest.mark.parametrize("kind", ["drift", "noise"])
def test_errors_that_do_not_depend_on_the_state_are_left_alone(kind: str) -> None:
    frames = there_and_back()
    generator = torch.Generator().manual_seed(0)
    if kind == "drift":  # the same state twice, with opposite errors
        sizes = torch.sin(2 * math.pi * torch.arange(40) / 40)
    else:
        sizes = torch.randn(40, generator=generator)
    corrections, found, refinement = learned(frames, sizes[:, None] * error_at(1.0))
    assert not found["rod"].applied
    given = state_at(0.4, 0.0)
    assert corrections.corrected(given) is given
    assert torch.equal(refinement.poses[:, 0], sizes[:, None] * error_at(1.0))


def test_few_instants_predict_nothing() -> None:
    frames = there_and_back(8)
    corrections, found, _ = learned(frames, torch.ones(8, 6))
    assert found == {}
    assert not corrections.weights.any()


def test_a_readings_error_is_predicted_with_its_own_verdict() -> None:
    frames = there_and_back()
    refinement = Refinement(RefineConfig(), frames, (ROD,), CPU)
    refinement.frame_steps += 1
    refinement.joints[:, 0] = torch.tensor([0.1 * (f.state.instruments["rod"].joints["jaw"] - 0.5) for f in frames])
    corrections = StateCorrections((ROD,), CPU)
    found = predict_corrections(corrections, refinement, frames)
    assert found["rod.jaw"].applied
    assert not found["rod"].applied
    moved = corrections.corrected(state_at(0.8, 0.0)).instruments["rod"]
    assert moved.joints["jaw"] == pytest.approx(0.83, abs=5e-3)
    assert torch.allclose(moved.pose, state_at(0.8, 0.0).instruments["rod"].pose.float())
    unrecorded = StateCorrections((replace(ROD, unrecorded=("jaw",)),), CPU)
    assert unrecorded.readings == ((),)  # found from the images, or interpolated


@pytest.mark.filterwarnings("error")
def test_a_state_that_is_being_learned_is_corrected_too() -> None:
    frames = there_and_back()
    places = [frame.state.instruments["rod"].joints["jaw"] for frame in frames]
    corrections, _, _ = learned(frames, torch.stack([error_at(place) for place in places]))
    jaw = torch.tensor(0.3, requires_grad=True)
    given = InstrumentState(state_at(0.3, 0.0).instruments["rod"].pose, {"jaw": jaw})  # type: ignore[dict-item]
    moved = corrections.corrected(State({"rod": given})).instruments["rod"]
    assert moved.joints["jaw"].requires_grad  # type: ignore[attr-defined]
