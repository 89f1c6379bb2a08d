"""Corrections to recorded poses."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from neeco.capture.kinematics import REVOLUTE, KinematicTree, Link
from neeco.capture.model import Capture, Frame, Instrument, InstrumentState, State, Uncertainty
from neeco.geometry.camera import Camera
from neeco.scene.drawable import Recorded
from neeco.states.contradictions import describe_contradictions
from neeco.states.refinement import RefineConfig, Refinement, Verdict

CPU = torch.device("cpu")
CAMERA = Camera(torch.eye(4, dtype=torch.float64), 60.0, 60.0, 32.0, 24.0, 64, 48)


def sliding_frames() -> tuple[Frame, ...]:
    """x grows by 10 mm/s."""
    frames = []
    for k in range(6):
        pose = torch.eye(4, dtype=torch.float64)
        pose[0, 3] = 10 * 0.04 * k
        frames.append(Frame(Path(f"{k}.png"), CAMERA, State({"rod": InstrumentState(pose)}, 0.04 * k), "train"))
    return tuple(frames)


def test_the_mean_correction_is_taken_out_of_the_frames_seen() -> None:
    refinement = Refinement(RefineConfig(frame_poses=True), sliding_frames(), (Instrument("rod"),), CPU)
    refinement.poses += torch.arange(6.0)[:, None, None]
    refinement.frame_steps[:4] = 1
    refinement.center()
    assert refinement.poses[:4].mean(0).abs().max() < 1e-6
    assert (refinement.poses[4:] == torch.tensor([4.0, 5.0])[:, None, None]).all()


def test_a_positive_latency_takes_the_pose_of_later() -> None:
    frames = sliding_frames()
    refinement = Refinement(RefineConfig(latency=True, start=0), frames, (Instrument("rod"),), CPU)
    refinement.latency.fill_(0.04)
    state, _, _ = refinement.apply(2, frames[2].state, CAMERA, 1)
    later = frames[3].state.instruments["rod"].pose.float()
    assert torch.allclose(state.instruments["rod"].pose, later, atol=1e-5)


def test_nothing_is_corrected_before_its_time() -> None:
    frames = sliding_frames()
    refinement = Refinement(RefineConfig(latency=True, frame_poses=True, start=400), frames, (Instrument("rod"),), CPU)
    refinement.poses += 1
    assert refinement.apply(2, frames[2].state, CAMERA, 399)[0] is frames[2].state
    assert refinement.apply(2, frames[2].state, CAMERA, 400)[0] is not frames[2].state


def test_corrections_of_another_shape_are_not_taken_up() -> None:
    refinement = Refinement(RefineConfig(latency=True), sliding_frames(), (Instrument("rod"),), CPU)
    kept = refinement.tensors()
    refinement.restore(kept)
    with pytest.raises(ValueError, match=r"latency: \[2\], not \[1\]"):
        refinement.restore(kept | {"latency": torch.zeros(2)})


def test_states_that_say_how_sure_they_are_are_corrected_accordingly() -> None:
    plain = sliding_frames()
    turn = torch.tensor([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]], dtype=torch.float64)  # its x is the camera's depth
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3] = turn.T
    sure = Uncertainty((0.1, 0.2, 3.0), (0.25, 1.0, 20.0))
    unsure = replace(plain[0], state=State({"rod": InstrumentState(pose, uncertainty=sure)}))
    config = RefineConfig(frame_poses=True, start=0)
    refinement = Refinement(config, (unsure, *plain[1:]), (Instrument("rod"),), CPU)
    usual = Refinement(config, plain, (Instrument("rod"),), CPU)
    expected = [*torch.tensor([0.25, 1.0, 20.0]).deg2rad().tolist(), 3.0, 0.2, 0.1]
    assert refinement.pose_sd[0, 0].tolist() == pytest.approx(expected, rel=1e-4)
    assert torch.equal(refinement.pose_sd[1:], usual.pose_sd[1:])
    for corrected in (refinement, usual):
        corrected.poses += 0.1
    penalties = [item.apply(0, unsure.state, CAMERA, 1)[2] for item in (refinement, usual)]
    assert float(penalties[0].detach()) < 0.5 * float(penalties[1].detach())


JAWS = KinematicTree((Link("shaft"), Link("jaw", "shaft", REVOLUTE, value={"jaw": 1.0})))


def seen_twice(unrecorded: tuple[str, ...] = ()) -> tuple[tuple[Frame, ...], Instrument]:
    """Every instant as two cameras see it, one after the other."""
    frames = [
        replace(frame, state=State({"rod": InstrumentState(frame.state.instruments["rod"].pose, {"jaw": 0.5})}, time))
        for time, frame in enumerate(sliding_frames())
        for _ in range(2)
    ]
    return tuple(frames), Instrument("rod", {"jaw": (0.0, 1.0)}, JAWS, unrecorded)


def test_readings_are_corrected_once_for_all_cameras_of_an_instant() -> None:
    frames, instrument = seen_twice()
    refinement = Refinement(RefineConfig(frame_joints=True, start=0), frames, (instrument,), CPU)
    state, _, penalty = refinement.apply(4, frames[4].state, CAMERA, 1)
    (state.instruments["rod"].joints["jaw"] + penalty).backward()
    refinement.step(4, 0.0)
    states = [refinement.apply(k, frames[k].state, CAMERA, 1)[0] for k in range(12)]
    readings = [float(torch.as_tensor(state.instruments["rod"].joints["jaw"]).detach()) for state in states]
    assert readings[4] == readings[5] < 0.5
    assert readings[:4] + readings[6:] == [0.5] * 10
    recorded = Recorded.of(frames, (instrument,))
    assert refinement.found(recorded, (instrument,)).states is recorded.states  # what was recorded stays


def on_scopes(apart: bool) -> tuple[tuple[Frame, ...], Instrument]:
    """`seen_twice` by the two cameras of a stereo scope, or by cameras of scopes that stand apart."""
    frames, instrument = seen_twice()
    right = torch.eye(4, dtype=torch.float64)
    right[0, 3] = 5.0
    lamps = None if apart else CAMERA.world_from_camera
    second = replace(CAMERA, world_from_camera=right, world_from_lamps=lamps)
    return tuple(replace(frame, camera=second) if k % 2 else frame for k, frame in enumerate(frames)), instrument


@pytest.mark.parametrize("apart", [False, True], ids=["stereo scope", "scopes apart"])
def test_a_state_is_corrected_once_for_all_cameras_of_an_instant(apart: bool) -> None:
    frames, instrument = on_scopes(apart)
    refinement = Refinement(RefineConfig(frame_poses=True, start=0), frames, (instrument,), CPU)
    state, _, _ = refinement.apply(4, frames[4].state, CAMERA, 1)
    state.instruments["rod"].pose[0, 3].backward()
    refinement.step(4, 0.0)

    def moved(frame: int) -> float:
        given = frames[frame].state
        found = refinement.apply(frame, given, CAMERA, 1)[0]
        return float(found.instruments["rod"].pose[0, 3].detach() - given.instruments["rod"].pose[0, 3])

    shifts = [moved(frame) for frame in range(12)]
    assert shifts[4] < 0
    assert shifts[5] == pytest.approx(shifts[4], abs=1e-7)
    assert shifts[:4] + shifts[6:] == pytest.approx([0.0] * 10, abs=1e-7)
    refinement.center()  # of the one instant seen, nothing is left
    assert moved(4) == pytest.approx(0.0, abs=1e-7)


def test_a_joint_that_nobody_recorded_is_found_within_its_limits_and_told_beside() -> None:
    frames, instrument = seen_twice(("jaw",))
    refinement = Refinement(RefineConfig(frame_joints=True, start=0), frames, (instrument,), CPU)
    refinement.joints += torch.tensor([-0.9, -0.2, 0.0, 0.1, 0.2, 0.9])[:, None]
    found = refinement.found(Recorded.of(frames, (instrument,)), (instrument,))
    values = [state.instruments["rod"].joints["jaw"] for state in found.states]
    assert values[::2] == pytest.approx([0.0, 0.3, 0.5, 0.6, 0.7, 1.0])

    def jaw(state: State) -> float:
        return found.with_unrecorded(state, (instrument,)).instruments["rod"].joints["jaw"]

    between = State({"rod": InstrumentState(frames[4].state.instruments["rod"].pose, {"jaw": 0.5})}, 2.0)
    assert jaw(between) == pytest.approx(0.5, abs=1e-3)
    beside = State({"rod": InstrumentState(frames[8].state.instruments["rod"].pose, {"jaw": 0.5})}, 4.0)
    assert jaw(beside) == pytest.approx(0.7, abs=1e-3)
    assert found.with_unrecorded(beside, (replace(instrument, unrecorded=()),)) is beside

    def jaws(capture: Capture) -> list[float]:
        return [
            frame.state.instruments["rod"].joints["jaw"] for frame in found.completed(capture, (instrument,)).frames
        ]

    capture = Capture(Path(), frames, (instrument,))
    assert jaws(capture)[::2] == pytest.approx(values[::2], abs=1e-3)
    stated = replace(capture, instruments=(replace(instrument, unrecorded=()),))  # another recording, which logs it
    assert jaws(stated) == [0.5] * len(frames)


def test_a_joint_that_nobody_recorded_follows_the_instants_beside() -> None:
    frames, instrument = seen_twice(("jaw",))
    frames = tuple(replace(frame, state=replace(frame.state, time=0.04 * frame.state.time)) for frame in frames)
    refinement = Refinement(RefineConfig(frame_joints=True, start=0), frames, (instrument,), CPU)
    refinement.joints += 0.3
    refinement.joints[2] = 0.0
    before, after = (refinement.apply(k, frames[k].state, CAMERA, 1)[2] for k in (4, 8))
    assert float(before.detach()) > 0
    assert float(after.detach()) == 0


@pytest.mark.parametrize("stated", [True, False], ids=["stated links", "hinges to be found"])
def test_a_state_that_is_set_holds_from_the_first_step_on_and_draws_what_is_learned(stated: bool) -> None:
    frames, instrument = on_scopes(apart=False)
    instrument = instrument if stated else replace(instrument, kinematics=None)
    config = RefineConfig(frame_poses=True, frame_joints=True, start=400)
    refinement = Refinement(config, frames, (instrument,), CPU)
    pose = frames[4].state.instruments["rod"].pose.clone()
    pose[:3, 3] += torch.tensor([1.0, 2.0, 3.0])
    moved = State({"rod": InstrumentState(pose, {"jaw": 0.8})}, frames[4].state.time)
    deviations = torch.tensor([0.01] * 3 + [0.1] * 3 + [0.02], dtype=torch.float64)
    refinement.set_state(4, frames[4].state, moved, deviations)
    assert torch.allclose(refinement.deviations(4), deviations)
    for iteration in (1, 500):
        found, _, penalty = refinement.apply(5, frames[5].state, CAMERA, iteration)  # the scope's other camera
        assert torch.allclose(found.instruments["rod"].pose.double().detach(), pose, atol=1e-5)
        assert float(torch.as_tensor(found.instruments["rod"].joints["jaw"]).detach()) == pytest.approx(0.8)
    assert penalty is not None
    assert float(penalty.detach()) == 0  # the prior is about what was set
    assert refinement.apply(6, frames[6].state, CAMERA, 1)[0] is frames[6].state
    recorded = Recorded.of(frames, (instrument,))
    kept = refinement.to_json(recorded)[frames[4].name]
    assert kept["fitted"]
    assert kept["instruments"]["rod"]["joints"]["jaw"] == pytest.approx(0.8)
    assert kept["instruments"]["rod"]["uncertainty"]["translation_mm"] == pytest.approx([0.1] * 3)
    refinement.judge(6, Verdict.EXCLUDED)  # both cameras
    left_out = refinement.to_json(recorded)[frames[6].name]
    assert left_out["left_out"]
    assert not kept["left_out"]
    assert "uncertainty" not in left_out["instruments"]["rod"]  # nothing is known of a state that nothing explains
    states = refinement.found(recorded, (instrument,)).states
    assert states[4].instruments["rod"].joints["jaw"] == pytest.approx(0.8)
    assert isinstance(states[4].instruments["rod"].joints["jaw"], float)  # as files need it
    assert states[6].instruments["rod"].joints["jaw"] == 0.5


def test_standard_deviations_of_exact_states_are_of_the_size_of_their_corrections() -> None:
    frames, instrument = on_scopes(apart=False)
    refinement = Refinement(RefineConfig(frame_poses=True, frame_joints=True), frames, (instrument,), CPU)
    before = refinement.deviations(0)
    generator = torch.Generator().manual_seed(0)
    refinement.frame_steps += 40
    refinement.poses = 0.2 * refinement.pose_sd * torch.randn(refinement.poses.shape, generator=generator)
    refinement.joints = 2.0 * refinement.joint_sd * torch.randn(refinement.joints.shape, generator=generator)
    refinement.set_state(4, frames[4].state, frames[4].state, 3 * before)
    refinement.scale_deviations(refinement.prior_shares())
    shares = refinement.deviations(0) / before
    assert torch.all((shares[:6] > 0.15) & (shares[:6] < 0.4))
    assert 2.0 < float(shares[6]) < 3.0  # larger than the prior, which knew nothing of them
    assert torch.allclose(refinement.deviations(4), 3 * before)  # a fit has its own


def test_standard_deviations_stay_where_an_image_could_not_be_fitted() -> None:
    """One that hardly shows the instrument corrects nothing, however wrong its state is."""
    frames, instrument = on_scopes(apart=False)
    refinement = Refinement(RefineConfig(frame_poses=True, frame_joints=True), frames, (instrument,), CPU)
    before = refinement.deviations(0)
    refinement.frame_steps += 40
    refinement.poses = 1e-4 * refinement.pose_sd
    for index in range(2, len(frames)):
        refinement.set_state(index, frames[index].state, frames[index].state, before)
    refinement.scale_deviations(refinement.prior_shares())
    assert torch.allclose(refinement.deviations(0), before)


def test_few_steps_tell_nothing_of_a_states_errors() -> None:
    """Corrections are small because steps were few, not because states were exact."""
    frames, instrument = on_scopes(apart=False)
    refinement = Refinement(RefineConfig(frame_poses=True), frames, (instrument,), CPU)
    refinement.frame_steps += 5
    refinement.poses = 0.1 * refinement.pose_sd
    assert refinement.prior_shares().tolist() == [1.0, 1.0, 1.0]
    refinement.frame_steps += 40
    assert max(refinement.prior_shares()[:2].tolist()) < 0.2


def test_standard_deviations_stay_where_nothing_was_corrected() -> None:
    frames, instrument = on_scopes(apart=False)
    refinement = Refinement(RefineConfig(frame_poses=True), frames, (instrument,), CPU)
    assert refinement.prior_shares().tolist() == [1.0, 1.0, 1.0]  # no step was taken
    refinement.frame_steps += 40
    refinement.poses += 1e-4
    shares = refinement.prior_shares().tolist()
    assert max(shares[:2]) < 0.1
    assert shares[2] == 1.0  # readings are not learned


def test_the_report_names_frames_that_were_fitted_anew_and_those_left_out_with_the_reason() -> None:
    refinement = Refinement(RefineConfig(frame_poses=True), sliding_frames(), (Instrument("rod"),), CPU)
    names = [f"frame {letter}" for letter in "abcdef"]
    assert describe_contradictions(refinement, names) == ""
    refinement.judge(1, Verdict.REFITTED)
    refinement.judge(3, Verdict.EXCLUDED)
    line = describe_contradictions(refinement, names)
    assert "1 fitted to their images from other states (frame b)" in line
    assert "1 left out, as no state explains their images (frame d)" in line
