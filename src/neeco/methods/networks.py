"""Shared parts of the methods that deform Gaussians by networks: encodings, ranges and settings."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor, nn

from neeco.base.errors import NeecoError
from neeco.capture.model import Instrument, State
from neeco.raster.devices import fast_bfloat16
from neeco.scene.deformation import LabelledByMotion

HALF_BY_DEFAULT: Mapping[str, Any] = {"deformation.half": None}  # decided by `PlaceNetwork` where training starts


class PlaceNetwork(LabelledByMotion):
    """Deformation by a network of a Gaussian's mean, which is normalised to [-1, 1] over the points."""

    large_operations = True

    mean_center: Tensor
    mean_halfwidth: Tensor

    def __init__(self, instruments: tuple[Instrument, ...], settings: Any = None) -> None:
        super().__init__(instruments, settings)
        self.warm_up = self.settings.warm_up
        self.register_buffer("mean_center", torch.zeros(3))
        self.register_buffer("mean_halfwidth", torch.ones(()))

    @classmethod
    def resolved(cls, settings: Any, begun: Any | None = None) -> Any:
        """Return `settings` with `half`, where None, as in those of the run that was `begun`, or else by whether this
        processor is fast at bfloat16."""
        if settings.half is not None:
            return settings
        return replace(settings, half=fast_bfloat16() if begun is None else begun.half)


def check_warm_up(share: float) -> None:
    """Raise NeecoError when `share` is not a share of the training in [0, 1)."""
    if not 0 <= share < 1:
        raise NeecoError(f"deformation.warm_up: {share} is not a share of the training in [0, 1)")


class RecordedTimes(nn.Module):
    """First time and duration (s) of the training frames, and their mean interval as a share of the duration."""

    start: Tensor
    duration: Tensor
    interval: Tensor

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("start", torch.zeros((), dtype=torch.float64))
        self.register_buffer("duration", torch.ones((), dtype=torch.float64))
        self.register_buffer("interval", torch.ones(()))

    def fit(self, states: list[State]) -> None:
        """Set all three by the training frames' states."""
        times = [state.time for state in states]
        self.start.fill_(min(times))
        self.duration.fill_(max(max(times) - min(times), 1e-9))
        self.interval.fill_(1 / len(times))

    def share(self, state: State) -> Tensor:
        """Return the time of `state`, a scalar: 0 and 1 at the first and last training frame."""
        return ((state.time - self.start) / self.duration).float()


def octave_angles(values: Tensor, count: int, unit: float = math.pi) -> Tensor:
    """Return angles [..., D, L] rad, unit * 2^k * x for k < L = `count`, of values [..., D]."""
    return values[..., None] * (unit * 2.0 ** torch.arange(count, dtype=values.dtype, device=values.device))


def octave_weights(opened: Tensor, count: int) -> Tensor:
    """Return the weight [L] of each octave k < L = `count`: (1 - cos(pi clamp(opened - k, 0, 1))) / 2 (Nerfies eq.
    5)."""
    octaves = torch.arange(count, device=opened.device)
    return (1 - torch.cos(math.pi * (opened - octaves).clamp(0, 1))) / 2


def encode(values: Tensor, count: int, unit: float = math.pi) -> Tensor:
    """Encode [..., D] as [..., 2 D L] (gamma): sines of every coordinate's L = `count` octaves, then cosines."""
    angles = octave_angles(values, count, unit).flatten(-2)
    return torch.cat([angles.sin(), angles.cos()], -1)


def robust_bounds(means: Tensor) -> tuple[Tensor, Tensor]:
    """Return the centre [3] and largest half extent [] mm of points [P, 3], without the outermost hundredth at either
    end."""
    low, high = means.quantile(0.01, 0), means.quantile(0.99, 0)
    return (low + high) / 2, (high - low).max() / 2
