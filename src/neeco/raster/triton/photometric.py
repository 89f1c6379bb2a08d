"""The kernels of training: the photometric loss with its gradient, and Adam.

The loss takes four launches over an image's numbers, none of which waits for the device. A lane is a number of the
image, so that neighbours across are 3 and neighbours down 3 W lanes away. SSIM's window is separable: one kernel blurs
across, the next one down and compares; gradients go back through the same two steps. Adam steps many tensors in one
launch: a table of addresses says what each program does.
"""

import math
from collections.abc import Sequence

import torch
import triton
import triton.language as tl
from torch import Tensor

from neeco.base.errors import NeecoError
from neeco.raster.triton.ready import working_on

BLOCK = 256  # numbers per program
TAPS = tl.constexpr(11)  # px, side of the window
REACH = tl.constexpr(5)
E = tl.constexpr(2.718281828459045)
SPREAD = tl.constexpr(2 * 1.5**2)  # 2 sigma^2
NORM = tl.constexpr(sum(2.718281828459045 ** (-((k - 5) ** 2) / (2 * 1.5**2)) for k in range(11)))
C1 = tl.constexpr(1e-4)
C2 = tl.constexpr(9e-4)


@triton.jit
def place_of(numbers, width, BLOCK: tl.constexpr):
    """A program's numbers [BLOCK] of the image, whether they are in it, and their columns."""
    at = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    return at, at < numbers, (at // 3 % width).to(tl.int32)


@triton.jit
def weight_of(k: tl.constexpr):
    """Weight of the window's tap k."""
    return E ** (0.0 - (k - REACH) * (k - REACH) / SPREAD) / NORM


@triton.jit
def seen_pair(image, target, mask, at, inside):
    """Numbers of both images, 0 where the mask is."""
    x, y = tl.load(image + at, inside, other=0.0), tl.load(target + at, inside, other=0.0)
    if mask is not None:
        counts = tl.load(mask + at // 3, inside, other=0).to(tl.float32)
        x, y = x * counts, y * counts
    return x, y


@triton.jit(do_not_specialize=["numbers", "width"])
def across_kernel(image, target, mask, blurred, numbers, width, BLOCK: tl.constexpr):
    """Windows' means along rows. blurred [5, numbers]: of x, y, x^2, y^2 and xy."""
    at, inside, column = place_of(numbers, width, BLOCK)
    mx = tl.zeros([BLOCK], tl.float32)
    my, mxx, myy, mxy = mx, mx, mx, mx
    for k in tl.static_range(TAPS):
        valid = inside & (column + (k - REACH) >= 0) & (column + (k - REACH) < width)
        x, y = seen_pair(image, target, mask, at + 3 * (k - REACH), valid)
        wx, wy = weight_of(k) * x, weight_of(k) * y
        mx, my, mxx, myy, mxy = mx + wx, my + wy, mxx + wx * x, myy + wy * y, mxy + wx * y
    to = blurred + at
    tl.store(to, mx, inside)
    tl.store(to + numbers, my, inside)
    tl.store(to + 2 * numbers, mxx, inside)
    tl.store(to + 3 * numbers, myy, inside)
    tl.store(to + 4 * numbers, mxy, inside)


@triton.jit
def column_mean(plane, at, inside, numbers, row):
    """A plane's mean over windows along columns, `row` numbers apart."""
    total = tl.zeros_like(at).to(tl.float32)
    for k in tl.static_range(TAPS):
        tap = at + (k - REACH) * row
        total += weight_of(k) * tl.load(plane + tap, inside & (tap >= 0) & (tap < numbers), other=0.0)
    return total


@triton.jit(do_not_specialize=["numbers", "width"])
def compare_kernel(image, target, mask, blurred, slopes, sums, numbers, width, ssim_weight, BLOCK: tl.constexpr):
    """sums [programs]: what each number adds to the loss, times the numbers that count. slopes [3, numbers]: its
    derivatives by the windows' means of x, x^2 and xy; None: not wanted."""
    at, inside, _ = place_of(numbers, width, BLOCK)
    row = 3 * width
    mx, my = column_mean(blurred, at, inside, numbers, row), column_mean(blurred + numbers, at, inside, numbers, row)
    vx = column_mean(blurred + 2 * numbers, at, inside, numbers, row) - mx * mx
    vy = column_mean(blurred + 3 * numbers, at, inside, numbers, row) - my * my
    vxy = column_mean(blurred + 4 * numbers, at, inside, numbers, row) - mx * my
    above1, above2 = 2 * mx * my + C1, 2 * vxy + C2
    below1, below2 = mx * mx + my * my + C1, vx + vy + C2
    inverse = 1 / (below1 * below2)
    ssim = above1 * above2 * inverse
    counts = tl.where(inside, 1.0, 0.0)
    if mask is not None:
        counts = tl.load(mask + at // 3, inside, other=0).to(tl.float32)
    x, y = seen_pair(image, target, mask, at, inside)
    loss = (1 - ssim_weight) * tl.abs(x - y) + ssim_weight * (1 - ssim) * counts
    tl.store(sums + tl.program_id(0), tl.sum(tl.where(inside, loss, 0.0), axis=0))
    if slopes is not None:
        outer = 0.0 - ssim_weight * counts
        by_mean = 2 * my * (above2 - above1) * inverse + 2 * mx * ssim * (1 / below2 - 1 / below1)
        tl.store(slopes + at, outer * by_mean, inside)
        tl.store(slopes + numbers + at, 0.0 - outer * ssim / below2, inside)
        tl.store(slopes + 2 * numbers + at, 2 * outer * above1 * inverse, inside)


@triton.jit(do_not_specialize=["numbers", "width"])
def slopes_across_kernel(slopes, blurred, numbers, width, BLOCK: tl.constexpr):
    """The three slopes' sums over windows along rows, into blurred [3, numbers]."""
    at, inside, column = place_of(numbers, width, BLOCK)
    a = tl.zeros([BLOCK], tl.float32)
    b, c = a, a
    for k in tl.static_range(TAPS):
        valid = inside & (column + (k - REACH) >= 0) & (column + (k - REACH) < width)
        at_tap = slopes + at + 3 * (k - REACH)
        a += weight_of(k) * tl.load(at_tap, valid, other=0.0)
        b += weight_of(k) * tl.load(at_tap + numbers, valid, other=0.0)
        c += weight_of(k) * tl.load(at_tap + 2 * numbers, valid, other=0.0)
    tl.store(blurred + at, a, inside)
    tl.store(blurred + numbers + at, b, inside)
    tl.store(blurred + 2 * numbers + at, c, inside)


@triton.jit(do_not_specialize=["numbers", "width"])
def gradient_kernel(image, target, mask, blurred, gradient, numbers, width, ssim_weight, BLOCK: tl.constexpr):
    """gradient [numbers] of the loss, times the numbers that count."""
    at, inside, _ = place_of(numbers, width, BLOCK)
    row = 3 * width
    x, y = seen_pair(image, target, mask, at, inside)
    total = column_mean(blurred, at, inside, numbers, row)
    total += 2 * x * column_mean(blurred + numbers, at, inside, numbers, row)
    total += y * column_mean(blurred + 2 * numbers, at, inside, numbers, row)
    total += (1 - ssim_weight) * (tl.where(x > y, 1.0, 0.0) - tl.where(x < y, 1.0, 0.0))
    if mask is not None:
        total *= tl.load(mask + at // 3, inside, other=0).to(tl.float32)
    tl.store(gradient + at, total, inside)


def photometric(
    image: Tensor, target: Tensor, mask: Tensor | None, ssim_weight: float, wanted: bool
) -> tuple[Tensor, Tensor | None]:
    """The loss [] of images [H, W, 3] float32 and of mask [H, W] bool, contiguous, and, if `wanted`, its gradient by
    `image`. The same inputs give the same bits."""
    numbers, width, device = image.numel(), image.shape[1], image.device
    programs = triton.cdiv(numbers, BLOCK)
    blurred = torch.empty(5, numbers, device=device)
    slopes = torch.empty(3, numbers, device=device) if wanted else None
    sums = torch.empty(programs, device=device)
    pixels = torch.full((), numbers / 3, device=device) if mask is None else mask.sum()
    count = (3 * pixels).clamp(min=1).float()
    launch = {"BLOCK": BLOCK, "num_warps": 4, "enable_fp_fusion": True}
    gradient = None
    with working_on(device):
        across_kernel[(programs,)](image, target, mask, blurred, numbers, width, **launch)
        compare_kernel[(programs,)](image, target, mask, blurred, slopes, sums, numbers, width, ssim_weight, **launch)
        if slopes is not None:
            gradient = torch.empty_like(image)
            slopes_across_kernel[(programs,)](slopes, blurred, numbers, width, **launch)
            gradient_kernel[(programs,)](image, target, mask, blurred, gradient, numbers, width, ssim_weight, **launch)
            gradient /= count
    return (sums.double().sum() / count).float(), gradient


ADAM_BLOCK = 1024  # numbers per program
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
    """Return the value at an address."""
    return address.to(tl.pointer_type(tl.float32))


@triton.jit
def adam_kernel(table, beta1, beta2, rest1, rest2, eps, SLOTS: tl.constexpr, ADAM_BLOCK: tl.constexpr):
    """One block of one tensor. table [FIELDS, SLOTS] int64, its tensors in the order of their programs."""
    program = tl.program_id(0)
    tensor = tl.sum((tl.load(table + tl.arange(0, SLOTS)) <= program).to(tl.int32), axis=0) - 1
    at = (program - column(table, 0, tensor, SLOTS)) * ADAM_BLOCK + tl.arange(0, ADAM_BLOCK)
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
    if any(each.device != device for four in tensors for each in four):
        raise NeecoError("adam_steps: tensors are on several devices; move them to one")
    table, programs = _table(tensors, rates, betas)
    if not programs:
        return
    if device.type == "cuda":
        table = table.pin_memory().to(device, non_blocking=True)
    with working_on(device):
        adam_kernel[(programs,)](
            table, betas[0], betas[1], 1 - betas[0], 1 - betas[1], eps,
            SLOTS=table.shape[1], ADAM_BLOCK=ADAM_BLOCK, num_warps=4, enable_fp_fusion=True,
        )  # fmt: skip


def _table(
    tensors: Sequence[Tensors], rates: Sequence[tuple[float, int]], betas: tuple[float, float]
) -> tuple[Tensor, int]:
    """Return the kernel's table [FIELDS, SLOTS] int64 and the number of programs. Slots left over begin behind the
    last."""
    first, rows, factors = 0, [], []
    for four, (rate, step) in zip(tensors, rates, strict=True):
        size = four[0].numel()
        rows.append([first, *(each.data_ptr() for each in four), size])
        factors.append([rate / (1 - betas[0] ** step), 1 / math.sqrt(1 - betas[1] ** step)])
        first += triton.cdiv(size, ADAM_BLOCK)
    table = torch.full((FIELDS, triton.next_power_of_2(len(rows))), first, dtype=torch.int64)
    table[:6, : len(rows)] = torch.tensor(rows, dtype=torch.int64).T
    table[6:, : len(rows)] = torch.tensor(factors, dtype=torch.float64).view(torch.int64).T
    return table, first
