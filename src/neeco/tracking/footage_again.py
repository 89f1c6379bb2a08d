"""TissueRenderer and light of footage learned again, once it is known where the instruments are.

At first the tissue is learned beside what passes; where an instrument's shadow nearly always falls, it is learned as
dark tissue, and highlights that were masked as passing are missing. Now the instruments are drawn where they were
tracked, with their shadow, and every pixel counts. They stay as they are: only tissue, light and lamps are learned.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from statistics import median

import torch
from torch import Tensor

from neeco.capture.model import Frame, State, evenly_spaced
from neeco.scene import GaussianScene
from neeco.scene.training_views import TrainingViews
from neeco.settings import with_fields
from neeco.tracking.follow import Step
from neeco.tracking.footage_tissue import Report
from neeco.training.config import TrainConfig, method_defaults
from neeco.training.session import new_session

ITERATIONS = 1000
FRAMES = 160  # learned from, at most
PLACED = 0.6  # overlap of the label from which a frame's state is used
MOST_MISFIT = 2.0  # times the median: frames explained worse are not used
FEWEST = 2  # frames without which nothing is learned again
CHANGES = {
    "refine.latency": False,
    "refine.frame_poses": False,
    "refine.frame_joints": False,
    "resolution.full_size_at": 0.0,
    "density_start": 10**9,
}


def usable(steps: Sequence[Step]) -> list[Step]:
    """Those in which the instruments are in place."""
    placed = [step for step in steps if step.how != "lost" and step.trust.overlap >= PLACED]
    most = MOST_MISFIT * median(step.misfit for step in placed) if placed else 0.0
    chosen = [step for step in placed if step.misfit <= most]
    return [chosen[k] for k in evenly_spaced(len(chosen), FRAMES)] if chosen else []


def learned_again(
    scene: GaussianScene, frames: Sequence[Frame], steps: Sequence[Step], report: Report
) -> GaussianScene:
    """`scene`, changed in place: its tissue and light from the frames that `steps` found the instruments in."""
    chosen = usable(steps)
    if len(chosen) < FEWEST:
        return scene
    given = [_placed(frames[step.frame], step.moving.state) for step in chosen]
    config: TrainConfig = with_fields(method_defaults(scene.method), {"iterations": ITERATIONS, **CHANGES})
    session = new_session(scene, TrainingViews.read(given).to(scene.center.device), config)
    scene.deformation.start_iteration = 10**9
    session.start()
    fixed = scene.canonical.of_instruments
    for tensor in scene.canonical.tensors().values():
        if tensor.requires_grad:
            tensor.register_hook(lambda gradient: _tissue_alone(gradient, fixed))
    while session.progress < 1:
        session.step()
        report("learning tissue and light again", session.iteration, ITERATIONS)
    session.scene.requires_grad_(False)
    for tensor in scene.canonical.tensors().values():
        tensor.requires_grad_(False)
    return scene


def _placed(frame: Frame, state: State) -> Frame:
    return replace(frame, split="train", state=replace(state, time=frame.state.time))


def _tissue_alone(gradient: Tensor, fixed: Tensor) -> Tensor:
    return torch.where(fixed.reshape(-1, *[1] * (gradient.dim() - 1)), 0.0, gradient)
