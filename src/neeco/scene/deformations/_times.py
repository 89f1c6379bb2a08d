"""The time of a state as methods without instrument states know it: as a share of the recording."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from neeco.capture.model import State


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
        """Take all three from the training frames' states."""
        times = [state.time for state in states]
        self.start.fill_(min(times))
        self.duration.fill_(max(max(times) - min(times), 1e-9))
        self.interval.fill_(1 / len(times))

    def share(self, state: State) -> Tensor:
        """The time of `state`, a scalar: 0 and 1 at the first and last training frame."""
        return ((state.time - self.start) / self.duration).float()
