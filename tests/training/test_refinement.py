"""Corrections to recorded poses."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from neeco.capture.model import Frame, Instrument, InstrumentState, State
from neeco.raster.types import Camera
from neeco.training.config import RefineConfig
from neeco.training.refinement import Refinement

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
