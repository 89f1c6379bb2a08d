"""`Session`: one run in memory, of any method. That of methods that deform Gaussians, which the hooks of their
deformation receive, is a room above: `neeco.training.session.GaussianSession`."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, field
from typing import Any

import torch
from torch import Tensor

from neeco.base.errors import NeecoError
from neeco.raster.optimizer import Adam
from neeco.scene.drawable import DrawableScene

UNLIMITED = 1_000_000_000  # iterations: minutes end the run long before
Report = Callable[[str], None]  # shows the user one line


@dataclass(frozen=True)
class RunLength:
    """Length of a run: `iterations`, or `minutes` if they end sooner."""

    iterations: int
    minutes: float | None = None
    min_share: float = 0.05  # of `iterations`, before which minutes do not end the run
    judged_share: float = 0.25  # of `iterations`: after fewer, labels and joints are not judged

    @property
    def open_ended(self) -> bool:
        """Whether minutes alone end the run: an equal budget for all methods, preparation included."""
        return self.iterations >= UNLIMITED

    def progress(self, iteration: int, seconds: float, prepared: float = 0.0) -> float:
        """Return the completed share of the run in [0, 1], by iterations or minutes, whichever is larger.

        prepared: those of `seconds` that passed before the first iteration, which do not count as minutes.
        """
        done = iteration / self.iterations
        if self.minutes is not None and self.open_ended:
            done = max(done, seconds / (60 * self.minutes))
        elif self.minutes is not None:
            floor = iteration / (self.min_share * self.iterations)
            done = max(done, min(floor, (seconds - prepared) / (60 * self.minutes)))
        return min(1.0, done)

    def is_short(self, iteration: int) -> bool:
        """Whether a run that ended after so many iterations is too short to judge what it learned."""
        return not self.open_ended and iteration < self.judged_share * self.iterations


@dataclass(frozen=True)
class StepResult:
    """Loss and PSNR of one training step."""

    loss: float
    psnr: float

    @classmethod
    def of(cls, loss: float, squared_error: float) -> StepResult:
        """Return the result of an image's loss and mean squared error."""
        return cls(loss, -10 * math.log10(max(squared_error, 1e-10)))

    @classmethod
    def mean(cls, results: Sequence[StepResult]) -> StepResult:
        """Return the mean over one or more images."""
        count = len(results)
        return cls(sum(result.loss for result in results) / count, sum(result.psnr for result in results) / count)


def numbers(*scalars: Tensor) -> list[float]:
    """Return the values of scalars on one device with a single synchronisation."""
    values: list[float] = torch.stack([scalar.detach() for scalar in scalars]).tolist()
    return values


def check_finite(total: float, iteration: int, where: str = "") -> None:
    """Raise NeecoError when the minimised loss is not finite."""
    if not math.isfinite(total):
        raise NeecoError(
            f"training: the loss became {total} at iteration {iteration}{where}; run `neeco check` on the capture, or "
            "train again with another --seed (the last checkpoint is kept)"
        )


def members(tensors: Mapping[str, Tensor], group: str) -> dict[str, Tensor]:
    """Return the tensors called GROUP/NAME by NAME."""
    return {key.removeprefix(f"{group}/"): t for key, t in tensors.items() if key.startswith(f"{group}/")}


@dataclass
class Session:
    """One training run in memory, of any method."""

    scene: DrawableScene
    length: RunLength
    generator: torch.Generator
    _: KW_ONLY
    adam: Adam = field(init=False)
    iteration: int = field(default=0, init=False)
    seconds: float = field(default=0.0, init=False)
    prepared: float = field(default=0.0, init=False)  # those of `seconds` before the first iteration
    window: list[StepResult] = field(default_factory=list, init=False)  # steps since the last row of metrics.jsonl

    @property
    def progress(self) -> float:
        """Completed share of the run in [0, 1]."""
        return self.length.progress(self.iteration, self.seconds, self.prepared)

    @property
    def phase(self) -> int:
        """1 or 2 of the dynamic training adjustment; 1 for a method without it."""
        return 1

    @property
    def forced(self) -> bool:
        """Whether phase 2 started because of the run's progress alone."""
        return False

    def step(self) -> StepResult:
        """Take one optimiser step. Raises NeecoError when the loss is not finite."""
        raise NotImplementedError

    def between_steps(self, before: float) -> None:
        """Do the work that is due at shares of the run between `before`, the progress at the last step, and
        `progress`."""

    def pack(self) -> tuple[dict[str, Tensor], dict[str, Any]]:
        """Return (tensors as GROUP/NAME, JSON-able fields) of a checkpoint in addition to scene, optimiser and
        generators."""
        return {}, {}

    def restore(self, tensors: Mapping[str, Tensor], fields: Mapping[str, Any]) -> None:
        """Restore the state that `pack` returned."""

    def training_states(self) -> dict[str, Any]:
        """Return the states of the training frames as corrected, by name (JSON-able); empty where none is learned."""
        return {}

    def finish(self) -> None:
        """Derive labels, verdicts and other results from the learned scene after the last step."""
