"""What a method and its training share. Training itself is above this room: `neeco.training`.

`Session` is one run in memory, of any method. `GaussianTraining` is a session of a method that deforms Gaussians, as
the hooks of its deformation see it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import torch
from torch import Tensor

from neeco.errors import NeecoError
from neeco.raster.optimizer import Adam
from neeco.scene.canonical import CanonicalGaussians
from neeco.scene.drawable import DrawableScene
from neeco.scene.training_views import TrainingViews

Report = Callable[[str], None]  # shows the user one line


@dataclass(frozen=True)
class RunLength:
    """When a run ends: after `iterations`, or after `minutes` if that is sooner."""

    iterations: int
    minutes: float | None = None

    def progress(self, iteration: int, seconds: float) -> float:
        """Share of the run in [0, 1] that is done, by iterations or minutes, whichever is further."""
        done = iteration / self.iterations
        if self.minutes is not None:
            done = max(done, seconds / (60 * self.minutes))
        return min(1.0, done)


@dataclass(frozen=True)
class StepResult:
    """Loss and PSNR of one training step."""

    loss: float
    psnr: float

    @classmethod
    def of(cls, loss: float, squared_error: float) -> StepResult:
        """From the image's loss and its mean squared error."""
        return cls(loss, -10 * math.log10(max(squared_error, 1e-10)))

    @classmethod
    def mean(cls, results: Sequence[StepResult]) -> StepResult:
        """Of several images, at least one."""
        count = len(results)
        return cls(sum(result.loss for result in results) / count, sum(result.psnr for result in results) / count)


def numbers(*scalars: Tensor) -> list[float]:
    """Values of scalars on one device, with a single synchronisation."""
    values: list[float] = torch.stack([scalar.detach() for scalar in scalars]).tolist()
    return values


def check_finite(total: float, iteration: int, where: str = "") -> None:
    """Raise NeecoError when the minimised loss is not finite."""
    if not math.isfinite(total):
        raise NeecoError(
            f"training: the loss became {total} at iteration {iteration}{where}; run `neeco check` on the capture, or "
            "train anew with another --seed (the last checkpoint is kept)"
        )


def members(tensors: Mapping[str, Tensor], group: str) -> dict[str, Tensor]:
    """The tensors called GROUP/NAME, by NAME."""
    return {key.removeprefix(f"{group}/"): t for key, t in tensors.items() if key.startswith(f"{group}/")}


@dataclass
class Session:
    """One training run in memory, of any method."""

    scene: DrawableScene
    length: RunLength
    generator: torch.Generator
    adam: Adam = field(init=False)
    iteration: int = field(default=0, init=False)
    seconds: float = field(default=0.0, init=False)
    window: list[StepResult] = field(default_factory=list, init=False)  # steps since the last row of metrics.jsonl

    @property
    def progress(self) -> float:
        """Share of the run in [0, 1] that is done."""
        return self.length.progress(self.iteration, self.seconds)

    @property
    def phase(self) -> int:
        """1 or 2 of the dynamic training adjustment; 1 for a method without it."""
        return 1

    @property
    def forced(self) -> bool:
        """Whether phase 2 began because the run was late."""
        return False

    def step(self) -> StepResult:
        """Take one optimiser step. Raises NeecoError when the loss is not finite."""
        raise NotImplementedError

    def between_steps(self, before: float) -> None:
        """Do what is due once `progress` has passed a mark; it was `before` at the last step."""

    def pack(self) -> tuple[dict[str, Tensor], dict[str, Any]]:
        """(tensors as GROUP/NAME, JSON-able fields) of a checkpoint beside scene, optimiser and random numbers."""
        return {}, {}

    def restore(self, tensors: Mapping[str, Tensor], fields: Mapping[str, Any]) -> None:
        """The inverse of `pack`."""

    def finish(self) -> None:
        """Compute what is derived from the learned scene after the last step."""


class CanonicalScene(DrawableScene, Protocol):
    """The part of `GaussianScene` that a deformation's hooks use."""

    canonical: CanonicalGaussians


@dataclass
class GaussianTraining(Session):
    """A training session as a deformation's hooks see it."""

    scene: CanonicalScene
    views: TrainingViews
    report: Report
    batch_size: int  # frames per step
    timed: bool = field(default=True, init=False)  # `State.time` is in seconds

    def reached(self, iteration: int) -> bool:
        """Whether the last step came to `iteration` or past it."""
        return self.iteration - self.batch_size < iteration <= self.iteration
