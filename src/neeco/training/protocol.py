"""What the run folder's logic asks of a training session, whatever it trains."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import torch
from torch import Tensor

from neeco.scene.nerfies.scene import NerfScene
from neeco.scene.scene import Scene
from neeco.training.config import TrainConfig
from neeco.training.optimizer import Adam

Report = Callable[[str], None]


@dataclass(frozen=True)
class StepResult:
    """What one step saw."""

    loss: float
    psnr: float


class TrainingSession(Protocol):
    """One training run in memory: `Session` for Gaussians, `NerfiesSession` for a field."""

    config: TrainConfig
    iteration: int
    seconds: float
    window: list[StepResult]  # steps since the last row of metrics.jsonl
    adam: Adam
    generator: torch.Generator

    @property
    def scene(self) -> Scene | NerfScene:
        """The scene as learned so far."""

    @property
    def progress(self) -> float:
        """Done share of the run in [0, 1]."""

    @property
    def phase(self) -> int:
        """1 or 2 of the dynamic training adjustment; 1 where there is none."""

    @property
    def forced(self) -> bool:
        """Whether phase 2 began because the run was late."""

    def step(self) -> StepResult:
        """Learn once. Raises NeecoError when the loss is no number."""

    def between_steps(self, before: float) -> None:
        """What is due once `progress` has passed a mark; it was `before` at the last step."""

    def pack(self) -> tuple[dict[str, Tensor], dict[str, Any]]:
        """(tensors as GROUP/NAME, JSON-able fields) a checkpoint needs beside scene, optimiser and random numbers."""

    def restore(self, tensors: dict[str, Tensor], fields: dict[str, Any]) -> None:
        """The inverse of `pack`."""

    def finish(self, report: Report) -> None:
        """Find out what is found once learning has ended."""


def done_share(config: TrainConfig, iteration: int, seconds: float) -> float:
    """Done share of a run in [0, 1], by iterations or minutes, whichever is further."""
    done = iteration / config.iterations
    if config.minutes is not None:
        done = max(done, seconds / (60 * config.minutes))
    return min(1.0, done)


def members(tensors: dict[str, Tensor], group: str) -> dict[str, Tensor]:
    """The tensors called GROUP/NAME, by NAME."""
    return {key.removeprefix(f"{group}/"): t for key, t in tensors.items() if key.startswith(f"{group}/")}
