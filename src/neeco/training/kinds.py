"""The two kinds of session: Gaussians, and a field."""

from __future__ import annotations

from collections.abc import Sequence

from torch import Tensor

from neeco.capture.model import Capture, Frame
from neeco.scene.methods import is_field
from neeco.scene.nerfies.scene import NerfScene
from neeco.scene.scene import Scene
from neeco.training.config import TrainConfig
from neeco.training.initial import initial_scene
from neeco.training.instruments.discovery import new_session
from neeco.training.nerfies import initial_field, new_nerfies_session
from neeco.training.protocol import Report, TrainingSession


def begin_session(
    capture: Capture,
    frames: tuple[Frame, ...],
    images: Sequence[Tensor],
    masks: Sequence[Tensor | None],
    config: TrainConfig,
    report: Report,
) -> TrainingSession:
    """The session of `config.method` before its first step, its scene begun from the capture."""
    scene: Scene | NerfScene
    if is_field(config.method):
        scene = initial_field(capture, frames, config)
    else:
        scene = initial_scene(capture, frames, images, masks, config, report)
    return session_around(scene, capture, frames, images, masks, config)


def session_around(
    scene: Scene | NerfScene,
    capture: Capture,
    frames: tuple[Frame, ...],
    images: Sequence[Tensor],
    masks: Sequence[Tensor | None],
    config: TrainConfig,
) -> TrainingSession:
    """A session at iteration 0 around a scene that is there already."""
    if isinstance(scene, NerfScene):
        return new_nerfies_session(scene, capture, frames, images, masks, config)
    return new_session(scene, frames, images, masks, config)
