"""Adam in one native pass per tensor.

The moments are plain tensors that belong to the caller: density control edits their rows, checkpoints save them.
"""

from __future__ import annotations

import torch
from torch import Tensor

from neeco.errors import NeecoError
from neeco.raster.native import native


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
    row_lr: Tensor | None = None,
) -> None:
    """One step of Adam (Kingma and Ba 2015), in place, without autograd.

    All tensors have param's shape [N, ...], float32, contiguous, CPU. step counts from 1. row_lr [N] multiplies the
    learning rate row by row. The same inputs give the same bits, whatever the number of threads. Raises NeecoError
    where tensors do not fit.
    """
    if step < 1:
        raise NeecoError(f"adam_step: step: {step}; counts from 1")
    for name, tensor in (("param", param), ("exp_avg", exp_avg), ("exp_avg_sq", exp_avg_sq)):
        if tensor.dtype != torch.float32 or tensor.device.type != "cpu" or not tensor.is_contiguous():
            raise NeecoError(f"adam_step: {name}: must be a contiguous float32 tensor on the CPU")
    row = None if row_lr is None else row_lr.detach().to(torch.float32).contiguous()
    try:
        native().adam(
            param.detach(), grad.detach().to(torch.float32).contiguous(), exp_avg, exp_avg_sq, row,
            lr, step, betas[0], betas[1], eps,
        )  # fmt: skip
    except ValueError as error:
        raise NeecoError(f"adam_step: {error}") from error
    # Autograd notices in-place changes by this counter, which native code does not touch.
    torch.autograd.graph.increment_version(param)
