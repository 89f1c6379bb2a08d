"""What training and a method say to each other. Training is above this room: here it is only described.

`Training` is what a deformation's hooks are given, `InstrumentSearch` what finds instruments and joints for them,
`Start` what a method begins with, `Session` what the run folder's logic asks of whatever it trains.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import torch
from torch import Tensor

from neeco.capture.model import Capture, Frame, Instrument
from neeco.errors import NeecoError
from neeco.raster.optimizer import Adam
from neeco.scene.canonical import CanonicalGaussians
from neeco.scene.drawable import Learned
from neeco.scene.hinges import Hinged
from neeco.scene.recorded import Recorded
from neeco.scene.swept import SweptVolume

Report = Callable[[str], None]  # news in words


@dataclass(frozen=True)
class StepResult:
    """What one step saw."""

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
    """The values of scalars on one device, for which it is waited once."""
    values: list[float] = torch.stack([scalar.detach() for scalar in scalars]).tolist()
    return values


def check_finite(total: float, iteration: int, where: str = "") -> None:
    """Raises NeecoError when what is to be minimised has become no number."""
    if not math.isfinite(total):
        raise NeecoError(
            f"training: the loss became {total} at iteration {iteration}{where}; run `neeco check` on the capture, or "
            "train anew with another --seed (the last checkpoint is kept)"
        )


class LearnedViews(Protocol):
    """The frames learned from, with their pixels (`neeco.training.views.TrainingViews`)."""

    @property
    def frames(self) -> tuple[Frame, ...]: ...
    @property
    def images(self) -> tuple[Tensor, ...]:
        """[H, W, 3] uint8, one per frame; in the host's memory where `device` is too small for them."""

    @property
    def masks(self) -> tuple[Tensor | None, ...]:
        """[H, W] bool, False where the loss does not look, or None; one per frame, where the images are."""

    @property
    def device(self) -> torch.device:
        """Where everything is computed."""


class Config(Protocol):
    """What a method's own session asks of the run's settings (`neeco.training.config.TrainConfig`)."""

    @property
    def method(self) -> str: ...
    @property
    def seed(self) -> int: ...
    @property
    def deformation(self) -> Any:
        """The method's own settings."""

    def done_share(self, iteration: int, seconds: float) -> float:
        """Done share of the run in [0, 1]."""


class GaussianScene(Protocol):
    """As much of a scene (`neeco.scene.scene.Scene`) as a method's hooks touch."""

    canonical: CanonicalGaussians
    instruments: tuple[Instrument, ...]
    recorded: Recorded
    diagnostics: dict[str, Any]


class InstrumentSearch(Protocol):
    """Finds instruments and their joints in the training views, without masks, CAD or labels."""

    def find(self, hinged: Hinged) -> None:
        """Carve every instrument, add its Gaussians to the scene as a body of its own, and start its hinges."""

    def bound(self, volume: SweptVolume) -> None:
        """Cover `volume` with what the carved instruments sweep."""

    def place_wrists(self, hinged: Hinged) -> None:
        """Find where each shaft ends and the wrist begins."""

    def replace_wrists(self, hinged: Hinged) -> None:
        """Look again, and move a wrist where spinning the shaft up to there costs no more than it did."""

    def find_shadow(self) -> None:
        """Find where lamps are that cast the instruments' shadows, beside those found before; none where none explains
        anything."""

    def conclude(self, hinged: Hinged) -> None:
        """Set each instrument's extent, prolong its shaft, and judge whether its joints were found."""


class Training(Protocol):
    """A training session as a deformation's hooks see it."""

    @property
    def scene(self) -> GaussianScene: ...
    @property
    def views(self) -> LearnedViews: ...
    @property
    def instruments(self) -> InstrumentSearch: ...
    @property
    def report(self) -> Report: ...
    @property
    def iteration(self) -> int: ...
    @property
    def progress(self) -> float:
        """Done share of the run in [0, 1]."""

    def reached(self, iteration: int) -> bool:
        """Was it this step that came to `iteration`, or past it?"""
        ...


class Session(Protocol):
    """One training run in memory, whatever it trains."""

    iteration: int
    seconds: float
    window: list[StepResult]  # steps since the last row of metrics.jsonl
    adam: Adam
    generator: torch.Generator

    @property
    def scene(self) -> Learned:
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

    def restore(self, tensors: Mapping[str, Tensor], fields: Mapping[str, Any]) -> None:
        """The inverse of `pack`."""

    def finish(self) -> None:
        """Find out what is found once learning has ended."""


@dataclass(frozen=True)
class Start:
    """What a method begins a session with. `gaussians` is training's own session, which serves every method that
    deforms Gaussians: around a scene that is there already, or, with None, around a new one."""

    capture: Capture
    views: LearnedViews
    config: Config
    report: Report
    gaussians: Callable[[Any | None], Session]
