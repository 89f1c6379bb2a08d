"""Adam: one native pass per tensor on the CPU, plain torch elsewhere.

The moments are plain tensors that belong to the caller: density control edits their rows, checkpoints save them.
"""

from __future__ import annotations

import torch
from torch import Tensor

from neeco.errors import NeecoError
from neeco.raster.native import goes_native, native


@torch.no_grad()
def adam_step(
    param: Tensor,
    grad: Tensor,
    exp_avg: Tensor,
    exp_avg_sq: Tensor,
    *,
    lr: float,
    step: int,
    betas: tuple[float, float] = (0.9, 0.999),
    eps: float = 1e-15,
) -> None:
    """One step of Adam (Kingma and Ba 2015), in place, without autograd.

    All tensors have param's shape [N, ...] and device, the moments its type too. step counts from 1. float32 on the CPU
    takes the native kernel, needs contiguous tensors, and gives the same bits from the same inputs, whatever the number
    of threads. Raises NeecoError where tensors do not fit.
    """
    if step < 1:
        raise NeecoError(f"adam_step: step: {step}; counts from 1")
    gradient = grad.detach().to(param.dtype)
    for name, tensor in (("grad", gradient), ("exp_avg", exp_avg), ("exp_avg_sq", exp_avg_sq)):
        if _kind(tensor) != _kind(param):
            raise NeecoError(f"adam_step: {name}: {_kind(tensor)}; expected {_kind(param)}, as the parameter")
    if not (goes_native(param) and param.dtype == torch.float32):
        param.sub_(lr * adam_update(gradient, exp_avg, exp_avg_sq, step, betas, eps))
        return
    for name, tensor in (("param", param), ("exp_avg", exp_avg), ("exp_avg_sq", exp_avg_sq)):
        if not tensor.is_contiguous():
            raise NeecoError(f"adam_step: {name}: must be contiguous")
    native().adam(param.detach(), gradient.contiguous(), exp_avg, exp_avg_sq, lr, step, *betas, eps)
    # Autograd notices in-place changes by this counter, which native code does not touch.
    torch.autograd.graph.increment_version(param)


@torch.no_grad()
def adam_update(
    grad: Tensor, mean: Tensor, square: Tensor, step: float, betas: tuple[float, float], eps: float
) -> Tensor:
    """The definition: both moments take `grad` in, in place; returns the step for a learning rate of 1."""
    mean.copy_(betas[0] * mean + (1 - betas[0]) * grad)
    square.copy_(betas[1] * square + (1 - betas[1]) * grad.square())
    return mean / (1 - betas[0] ** step) / ((square / (1 - betas[1] ** step)).sqrt() + eps)


def _kind(tensor: Tensor) -> str:
    return f"{str(tensor.dtype).removeprefix('torch.')} {list(tensor.shape)} on {tensor.device}"


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
