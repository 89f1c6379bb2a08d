"""Adam over named tensors, with moments that density control can edit and checkpoints can save."""

from __future__ import annotations

import torch
from torch import Tensor

from neeco.raster.optimizer import adam_step


class Adam:
    """One learning rate per call; each tensor keeps its own step count (Kingma & Ba 2015, eps 1e-15 as in 3DGS)."""

    def __init__(self) -> None:
        self.first: dict[str, Tensor] = {}
        self.second: dict[str, Tensor] = {}
        self.steps: dict[str, int] = {}

    @torch.no_grad()
    def step(self, name: str, parameter: Tensor, learning_rate: float) -> None:
        """Update `parameter` in place by its gradient and clear the gradient. Without a gradient nothing happens."""
        if parameter.grad is None:
            return
        if name not in self.first:
            self.first[name], self.second[name] = torch.zeros_like(parameter), torch.zeros_like(parameter)
            self.steps[name] = 0
        self.steps[name] += 1
        adam_step(
            parameter.detach(),
            parameter.grad.contiguous(),
            self.first[name],
            self.second[name],
            lr=learning_rate,
            step=self.steps[name],
        )
        parameter.grad = None

    def select_rows(self, names: list[str], index: Tensor, fresh: Tensor) -> None:
        """Keep the moments of rows `index` [M]; rows marked `fresh` [M] start at zero."""
        for name in names:
            for moments in (self.first, self.second):
                if name in moments:
                    moments[name] = moments[name][index].contiguous()
                    moments[name][fresh] = 0

    def forget(self, name: str) -> None:
        """Zero one tensor's moments."""
        for moments in (self.first, self.second):
            if name in moments:
                moments[name].zero_()

    def tensors(self) -> dict[str, Tensor]:
        """Moments by name, for a checkpoint."""
        return {f"first.{n}": t for n, t in self.first.items()} | {f"second.{n}": t for n, t in self.second.items()}

    def restore(self, tensors: dict[str, Tensor], steps: dict[str, int]) -> None:
        """The inverse of `tensors` and `steps`."""
        self.first = {n.removeprefix("first."): t for n, t in tensors.items() if n.startswith("first.")}
        self.second = {n.removeprefix("second."): t for n, t in tensors.items() if n.startswith("second.")}
        self.steps = dict(steps)
