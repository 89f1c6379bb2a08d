"""Adam: one native pass per tensor on the CPU, one Triton launch for all tensors on CUDA, plain torch elsewhere.

The moments are plain tensors owned by the caller: density control edits their rows, checkpoints save them.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from neeco.base.errors import NeecoError
from neeco.raster.native import all_run_native, native
from neeco.raster.triton.ready import runs_triton

BETAS = (0.9, 0.999)
EPS = 1e-15  # as in 3DGS


@dataclass(frozen=True)
class Update:
    """One tensor of a step. All tensors have the parameter's shape [N, ...], type and device."""

    parameter: Tensor
    gradient: Tensor
    exp_avg: Tensor
    exp_avg_sq: Tensor
    lr: float
    step: int  # counts from 1


@torch.no_grad()
def adam_steps(updates: Sequence[Update], betas: tuple[float, float] = BETAS, eps: float = EPS) -> None:
    """Apply a step of Adam to each of several tensors, in place, without autograd.

    float32 on the CPU takes the native kernel, float32 on a CUDA device one Triton launch for all tensors (not tested
    on a GPU), everything else plain torch. Both kernels need contiguous tensors and are deterministic, the native one
    for any number of threads. Raises NeecoError where tensors do not fit.
    """
    together: list[Update] = []
    for update in updates:
        _check(update)
        parameter = update.parameter
        by_triton = runs_triton(parameter)
        if not by_triton and not all_run_native(parameter):
            moved = adam_update(update.gradient, update.exp_avg, update.exp_avg_sq, update.step, betas, eps)
            parameter.sub_(update.lr * moved)
            continue
        for name in ("parameter", "exp_avg", "exp_avg_sq"):
            if not getattr(update, name).is_contiguous():
                raise NeecoError(f"adam_step: {name}: must be contiguous")
        if by_triton:
            together.append(update)
        else:  # as arrays of NumPy, which reach the kernel in a third of the time
            tensors = (update.parameter.detach(), update.gradient.contiguous(), update.exp_avg, update.exp_avg_sq)
            native().adam(*(tensor.numpy() for tensor in tensors), update.lr, update.step, *betas, eps)
    if together:
        from neeco.raster.triton.photometric import step_together

        groups = [(u.parameter, u.gradient.contiguous(), u.exp_avg, u.exp_avg_sq) for u in together]
        step_together(groups, [(u.lr, u.step) for u in together], betas, eps)
    # the counter by which autograd detects in-place changes; kernels do not increment it
    for update in updates:
        torch.autograd.graph.increment_version(update.parameter)


@torch.no_grad()
def adam_update(
    grad: Tensor, mean: Tensor, square: Tensor, step: float, betas: tuple[float, float], eps: float
) -> Tensor:
    """Update both moments by `grad` in place (the definition); return the step for a learning rate of 1."""
    mean.copy_(betas[0] * mean + (1 - betas[0]) * grad)
    square.copy_(betas[1] * square + (1 - betas[1]) * grad.square())
    return mean / (1 - betas[0] ** step) / ((square / (1 - betas[1] ** step)).sqrt() + eps)


def _check(update: Update) -> None:
    if update.step < 1:
        raise NeecoError(f"adam_step: step: must be at least 1 (got {update.step})")
    parameter = update.parameter
    for name in ("gradient", "exp_avg", "exp_avg_sq"):
        other: Tensor = getattr(update, name)
        if (other.dtype, other.shape, other.device) != (parameter.dtype, parameter.shape, parameter.device):
            raise NeecoError(f"adam_step: {name}: is {_kind(other)}; expected {_kind(parameter)}, as the parameter")


def _kind(tensor: Tensor) -> str:
    return f"{str(tensor.dtype).removeprefix('torch.')} {list(tensor.shape)} on {tensor.device}"


class Adam:
    """Adam with a learning rate per tensor and step, and a step count per tensor (eps 1e-15 as in 3DGS).

    `views`: the number of images that the gradients of a step average. Rates, stated for one image, are multiplied by
    its root, and the betas raised to its power (Zhao et al. 2024, "On Scaling Up 3D Gaussian Splatting Training"; to
    first order also gsplat's rule), so that a batch has about the effect of its images one by one.
    """

    def __init__(self, views: int = 1) -> None:
        self.rate_scale = math.sqrt(views)
        self.betas = (BETAS[0] ** views, BETAS[1] ** views)
        self.first: dict[str, Tensor] = {}
        self.second: dict[str, Tensor] = {}
        self.steps: dict[str, int] = {}

    @torch.no_grad()
    def step(self, learned: Iterable[tuple[str, Tensor, float]]) -> None:
        """Update parameters, given with names and learning rates, in place by their gradients, and clear the gradients.
        Parameters without a gradient are skipped."""
        updates = []
        for name, parameter, rate in learned:
            if parameter.grad is None:
                continue
            if name not in self.first:
                self.first[name], self.second[name] = torch.zeros_like(parameter), torch.zeros_like(parameter)
                self.steps[name] = 0
            self.steps[name] += 1
            moments, lr = (self.first[name], self.second[name]), self.rate_scale * rate
            updates.append(Update(parameter.detach(), parameter.grad.contiguous(), *moments, lr, self.steps[name]))
            parameter.grad = None
        adam_steps(updates, self.betas)

    def select_rows(self, names: list[str], index: Tensor, fresh: Tensor) -> None:
        """Keep the moments of rows `index` [M]; rows marked `fresh` [M] start at zero."""
        for name in names:
            for moments in (self.first, self.second):
                if name in moments:
                    moments[name] = moments[name][index].contiguous()
                    moments[name][fresh] = 0

    def forget(self, name: str) -> None:
        """Reset one tensor's moments to zero."""
        for moments in (self.first, self.second):
            if name in moments:
                moments[name].zero_()

    def tensors(self) -> dict[str, Tensor]:
        """Return the moments by name, for a checkpoint."""
        return {f"first.{n}": t for n, t in self.first.items()} | {f"second.{n}": t for n, t in self.second.items()}

    def restore(self, tensors: dict[str, Tensor], steps: dict[str, int]) -> None:
        """Restore `tensors` and `steps`."""
        self.first = {n.removeprefix("first."): t for n, t in tensors.items() if n.startswith("first.")}
        self.second = {n.removeprefix("second."): t for n, t in tensors.items() if n.startswith("second.")}
        self.steps = dict(steps)
