"""Adam: one native pass per tensor on the CPU, plain torch elsewhere.

The moments are plain tensors that belong to the caller: density control edits their rows, checkpoints save them.
"""

from __future__ import annotations

import math

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
    if goes_native(param) and param.dtype == torch.float32:
        _native_step(param, gradient, exp_avg, exp_avg_sq, lr, step, betas, eps)
    else:
        _torch_step(param, gradient, exp_avg, exp_avg_sq, lr, step, betas, eps)


def _native_step(
    param: Tensor,
    grad: Tensor,
    mean: Tensor,
    square: Tensor,
    lr: float,
    step: int,
    betas: tuple[float, float],
    eps: float,
) -> None:
    for name, tensor in (("param", param), ("exp_avg", mean), ("exp_avg_sq", square)):
        if not tensor.is_contiguous():
            raise NeecoError(f"adam_step: {name}: must be contiguous")
    native().adam(param.detach(), grad.contiguous(), mean, square, lr, step, *betas, eps)
    # Autograd notices in-place changes by this counter, which native code does not touch.
    torch.autograd.graph.increment_version(param)


def _torch_step(
    param: Tensor,
    grad: Tensor,
    mean: Tensor,
    square: Tensor,
    lr: float,
    step: int,
    betas: tuple[float, float],
    eps: float,
) -> None:
    """The definition."""
    mean.lerp_(grad, 1 - betas[0])
    square.mul_(betas[1]).addcmul_(grad, grad, value=1 - betas[1])
    spread = (square.sqrt() / math.sqrt(1 - betas[1] ** step)).add_(eps)
    param.addcdiv_(mean, spread, value=-lr / (1 - betas[0] ** step))


def _kind(tensor: Tensor) -> str:
    return f"{str(tensor.dtype).removeprefix('torch.')} {list(tensor.shape)} on {tensor.device}"
