"""Adam's step of many tensors in one launch: what each program does, a table of addresses says."""

import math
from collections.abc import Sequence

import torch
import triton
import triton.language as tl
from torch import Tensor

from neeco.errors import NeecoError
from neeco.raster.triton.ready import working_on

BLOCK = 1024  # numbers per program
FIELDS = 8  # of a tensor: its first program, addresses of the four, size, two factors as float64's bits
Tensors = tuple[Tensor, Tensor, Tensor, Tensor]  # parameter, gradient and the two moments


@triton.jit
def column(table, k: tl.constexpr, tensor, SLOTS: tl.constexpr):
    """Field k of a tensor."""
    return tl.load(table + k * SLOTS + tensor)


@triton.jit
def factor(table, k: tl.constexpr, tensor, SLOTS: tl.constexpr):
    """Field k of a tensor, where that is a float64."""
    return column(table, k, tensor, SLOTS).to(tl.float64, bitcast=True).to(tl.float32)


@triton.jit
def numbers_at(address):
    """What an address points to."""
    return address.to(tl.pointer_type(tl.float32))


@triton.jit
def adam_kernel(table, beta1, beta2, rest1, rest2, eps, SLOTS: tl.constexpr, BLOCK: tl.constexpr):
    """One block of one tensor. table [FIELDS, SLOTS] int64, its tensors in the order of their programs."""
    program = tl.program_id(0)
    tensor = tl.sum((tl.load(table + tl.arange(0, SLOTS)) <= program).to(tl.int32), axis=0) - 1
    at = (program - column(table, 0, tensor, SLOTS)) * BLOCK + tl.arange(0, BLOCK)
    inside = at < column(table, 5, tensor, SLOTS)
    parameter, gradient = numbers_at(column(table, 1, tensor, SLOTS)), numbers_at(column(table, 2, tensor, SLOTS))
    mean, square = numbers_at(column(table, 3, tensor, SLOTS)), numbers_at(column(table, 4, tensor, SLOTS))
    g = tl.load(gradient + at, inside, other=0.0)
    m = beta1 * tl.load(mean + at, inside, other=0.0) + rest1 * g
    v = beta2 * tl.load(square + at, inside, other=0.0) + rest2 * g * g
    tl.store(mean + at, m, inside)
    tl.store(square + at, v, inside)
    step = factor(table, 6, tensor, SLOTS) * m / (tl.sqrt(v) * factor(table, 7, tensor, SLOTS) + eps)
    tl.store(parameter + at, tl.load(parameter + at, inside, other=0.0) - step, inside)


def step_together(
    tensors: Sequence[Tensors], rates: Sequence[tuple[float, int]], betas: tuple[float, float], eps: float
) -> None:
    """Step contiguous float32 `tensors` of one device, each by its (learning rate, step count from 1).

    Waits for nothing: the table goes to the device behind what that has yet to do.
    """
    device = tensors[0][0].device
    if any(held.device != device for four in tensors for held in four):
        raise NeecoError("adam_steps: tensors are on several devices; move them to one")
    table, programs = _table(tensors, rates, betas)
    if not programs:
        return
    if device.type == "cuda":
        table = table.pin_memory().to(device, non_blocking=True)
    with working_on(device):
        adam_kernel[(programs,)](
            table, betas[0], betas[1], 1 - betas[0], 1 - betas[1], eps,
            SLOTS=table.shape[1], BLOCK=BLOCK, num_warps=4, enable_fp_fusion=True,
        )  # fmt: skip


def _table(
    tensors: Sequence[Tensors], rates: Sequence[tuple[float, int]], betas: tuple[float, float]
) -> tuple[Tensor, int]:
    """What the kernel reads, [FIELDS, SLOTS] int64, and the number of programs. Slots left over begin behind the
    last."""
    first, rows, factors = 0, [], []
    for four, (rate, step) in zip(tensors, rates, strict=True):
        size = four[0].numel()
        rows.append([first, *(held.data_ptr() for held in four), size])
        factors.append([rate / (1 - betas[0] ** step), 1 / math.sqrt(1 - betas[1] ** step)])
        first += triton.cdiv(size, BLOCK)
    table = torch.full((FIELDS, triton.next_power_of_2(len(rows))), first, dtype=torch.int64)
    table[:6, : len(rows)] = torch.tensor(rows, dtype=torch.int64).T
    table[6:, : len(rows)] = torch.tensor(factors, dtype=torch.float64).view(torch.int64).T
    return table, first
