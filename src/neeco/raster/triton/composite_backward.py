"""Stage 4: the gradient of blending, back to front, summed over pixels for every Gaussian.

Sums of a Gaussian: of h, h dx, h dy, h dx^2, h dx dy, h dy^2 with h = alpha dL/dalpha (0 where alpha is clamped), then
dL/d red, green, blue, depth and the channels. A Gaussian's tiles are added up atomically, in any order, or, where torch
asks for deterministic algorithms, through a slot for every (tile, Gaussian) pair, in a fixed order.
"""

import torch
import triton
import triton.language as tl
from torch import Tensor

from neeco.raster.triton.binning import Lists, Tiles
from neeco.raster.triton.composite import HELD_MOST, OPAQUE, Images, exponent_of, field, groups, pixels_of
from neeco.raster.triton.project import LOG2_FAINTEST, RECORD

CHUNK = 2  # Gaussians whose loads overlap
HEAD = tl.constexpr(10)  # sums of a Gaussian without channels
SHAPE = tl.constexpr(6)  # those of h, which is linear in the values: every group of channels has its own
SLOTS = 16  # slots added at a time


@triton.jit
def placed(vector, index, place, value):
    """A small vector with the sum of `value` [P] at `place`."""
    return tl.where(index == place, tl.sum(value, axis=0), vector)


@triton.jit
def wanted_colors(to_color, to_alpha, to_depth, alpha, depth, background, pixel, inside, x):
    """Gradients of red, green, blue and of a weight by its depth; the drawn depth; what lies behind everything."""
    behind, red, green, blue = tl.zeros_like(x), tl.zeros_like(x), tl.zeros_like(x), tl.zeros_like(x)
    drawn_depth, to_distance = tl.zeros_like(x), tl.zeros_like(x)
    if to_color is not None:
        red = tl.load(to_color + pixel * 3, inside, other=0.0)
        green = tl.load(to_color + pixel * 3 + 1, inside, other=0.0)
        blue = tl.load(to_color + pixel * 3 + 2, inside, other=0.0)
        if background is not None:
            behind += red * tl.load(background) + green * tl.load(background + 1) + blue * tl.load(background + 2)
    if to_alpha is not None:
        behind -= tl.load(to_alpha + pixel, inside, other=0.0)
    if to_depth is not None:
        # depth = sum of weight * z / alpha, so d depth / d weight = (z - depth) / alpha
        drawn_alpha = tl.load(alpha + pixel, inside, other=0.0)
        drawn_depth = tl.load(depth + pixel, inside, other=0.0)
        wanted = tl.load(to_depth + pixel, inside, other=0.0) / tl.where(drawn_alpha > 0, drawn_alpha, 1.0)
        to_distance = tl.where(drawn_alpha > 0, wanted, 0.0)
    return red, green, blue, to_distance, drawn_depth, behind


@triton.jit
def wanted_channel(to_channels, pixel, inside, ch, C: tl.constexpr, x):
    """Gradient of a channel, 0 beyond the last."""
    if to_channels is None:
        wanted = tl.zeros_like(x)
    else:
        wanted = tl.load(to_channels + pixel.to(tl.int64) * C + ch, tl.where(inside, ch, C) < C, other=0.0)
    return wanted


@triton.jit(do_not_specialize=["width", "height", "columns", "first"])
def composite_backward_kernel(
    records, channels, gaussians, slots, starts, background, alpha, depth, left, full_at,
    to_color, to_alpha, to_depth, to_channels, sums, width, height, columns, first,
    COLOR: tl.constexpr, HELD: tl.constexpr, C: tl.constexpr, WIDTH: tl.constexpr, TILE: tl.constexpr,
    CHUNK: tl.constexpr, SLOTTED: tl.constexpr,
):  # fmt: skip
    """One tile and group of channels per program. sums: [pairs, WIDTH] by slots if SLOTTED, else [N, WIDTH]."""
    tile = tl.program_id(0)
    ch = first + tl.program_id(1) * HELD_MOST
    pixel, inside, x, y = pixels_of(tile, columns, width, height, TILE)
    stop = tl.load(full_at + pixel, inside, other=-1)
    transmittance = tl.load(left + pixel, inside, other=0.0)
    # behind: sum over what lies behind of weight * (gradient . value), minus dL/dalpha * transmittance
    behind = tl.zeros_like(x)
    index = tl.arange(0, 16)
    # where in a row each sum goes: the group's own h, then the values
    to_column = tl.where(index < SHAPE, (ch // HELD_MOST - 1) * SHAPE + index + (HEAD + C), ch + index + (HEAD - SHAPE))
    most = tl.minimum(C - ch, HELD) + SHAPE
    if COLOR:
        red, green, blue, to_distance, drawn_depth, behind = wanted_colors(
            to_color, to_alpha, to_depth, alpha, depth, background, pixel, inside, x
        )
        behind *= transmittance
        to_column = index
        most = HEAD + HELD
    if HELD > 0:
        v0 = wanted_channel(to_channels, pixel, inside, ch, C, x)
    if HELD > 1:
        v1 = wanted_channel(to_channels, pixel, inside, ch + 1, C, x)
    if HELD > 2:
        v2 = wanted_channel(to_channels, pixel, inside, ch + 2, C, x)
    if HELD > 3:
        v3 = wanted_channel(to_channels, pixel, inside, ch + 3, C, x)
    VALUES: tl.constexpr = 10 if COLOR else 6  # place of the first channel in the vector of sums

    begin = tl.load(starts + tile)
    k = tl.minimum(tl.load(starts + tile + 1), tl.max(stop, axis=0).to(tl.int64) + begin).to(tl.int32) - 1
    while k >= begin:
        for j in tl.static_range(CHUNK):
            listed = k - j >= begin
            g = tl.load(gaussians + k - j, listed, other=0).to(tl.int64)
            record = records + g * RECORD
            dx, dy = x - field(record, 0, listed), y - field(record, 1, listed)
            exponent = exponent_of(record, dx, dy, listed)
            raw = tl.exp2(exponent)
            drawn = (exponent >= LOG2_FAINTEST) & (k - j - begin < stop) & listed
            opacity = tl.where(drawn, tl.minimum(raw, OPAQUE), 0.0)
            scale = 1.0 / (1.0 - opacity)
            transmittance *= scale  # now that before this Gaussian
            weight = opacity * transmittance
            agreement = tl.zeros_like(x)
            if COLOR:
                agreement += red * field(record, 6, listed) + green * field(record, 7, listed)
                agreement += blue * field(record, 8, listed)
                # z and depth nearly cancel: subtract them before anything is rounded
                agreement += to_distance * (field(record, 9, listed) - drawn_depth)
            values = channels if HELD == 0 else channels + g * C + ch
            if HELD > 0:
                agreement += v0 * tl.load(values, listed & (ch < C), other=0.0)
            if HELD > 1:
                agreement += v1 * tl.load(values + 1, listed & (ch + 1 < C), other=0.0)
            if HELD > 2:
                agreement += v2 * tl.load(values + 2, listed & (ch + 2 < C), other=0.0)
            if HELD > 3:
                agreement += v3 * tl.load(values + 3, listed & (ch + 3 < C), other=0.0)
            h = tl.where(drawn & (raw <= OPAQUE), raw * (transmittance * agreement - behind * scale), 0.0)
            behind += weight * agreement
            hx, hy = h * dx, h * dy
            total = placed(tl.zeros([16], tl.float32), index, 0, h)
            total = placed(placed(total, index, 1, hx), index, 2, hy)
            total = placed(placed(placed(total, index, 3, hx * dx), index, 4, hx * dy), index, 5, hy * dy)
            if COLOR:
                total = placed(placed(total, index, 6, weight * red), index, 7, weight * green)
                total = placed(placed(total, index, 8, weight * blue), index, 9, weight * to_distance)
            if HELD > 0:
                total = placed(total, index, VALUES, weight * v0)
            if HELD > 1:
                total = placed(total, index, VALUES + 1, weight * v1)
            if HELD > 2:
                total = placed(total, index, VALUES + 2, weight * v2)
            if HELD > 3:
                total = placed(total, index, VALUES + 3, weight * v3)
            add = index < tl.where(listed, most, 0)
            if SLOTTED:
                to = sums + tl.load(slots + k - j, listed, other=0) * WIDTH
                tl.store(to + to_column, total, add)
            else:
                tl.atomic_add(sums + g * WIDTH + to_column, total, add, sem="relaxed")
        k -= CHUNK


@triton.jit
def sum_slots_kernel(
    slot_sums, order, slot_ends, sums, WIDTH: tl.constexpr, PADDED: tl.constexpr, SLOTS: tl.constexpr
):  # fmt: skip
    """Adds the slots of one Gaussian per program, in an order that depends on nothing else."""
    place = tl.program_id(0)
    g = tl.load(order + place)
    k = tl.load(slot_ends + place - 1, place > 0, other=0)
    end = tl.load(slot_ends + place)
    column = tl.arange(0, PADDED)[None, :]
    slot = tl.arange(0, SLOTS)[:, None]
    total = tl.zeros([SLOTS, PADDED], tl.float32)
    while k < end:
        total += tl.load(slot_sums + (k + slot) * WIDTH + column, (k + slot < end) & (column < WIDTH), other=0.0)
        k += SLOTS
    column = tl.arange(0, PADDED)
    tl.store(sums + g * WIDTH + column, tl.sum(total, axis=0), column < WIDTH)


def composite_backward(
    records: Tensor, channels: Tensor | None, lists: Lists, background: Tensor | None, tiles: Tiles, images: Images,
    gradients: tuple[Tensor | None, Tensor | None, Tensor | None, Tensor | None],
) -> Tensor:  # fmt: skip
    """Sums [N, 10 + C] of every Gaussian, from the gradients of colour, alpha, depth and channels.

    The same bits every time where `torch.are_deterministic_algorithms_enabled()`.
    """
    n, device = records.shape[0], records.device
    height, width = images.alpha.shape
    count = 0 if channels is None else channels.shape[1]
    # without a gradient of theirs, channels need no programs
    launches = groups(0 if gradients[3] is None else count)
    more = sum(programs for _, programs, _ in launches[1:])
    columns = HEAD.value + count + more * SHAPE.value
    slotted = torch.are_deterministic_algorithms_enabled()
    sums = torch.zeros(len(lists.gaussians) if slotted else n, columns, device=device)
    for first, programs, held in launches if len(lists.gaussians) else ():
        composite_backward_kernel[(tiles.count, programs)](
            records, channels, lists.gaussians, lists.slots, lists.starts, background,
            images.alpha, images.depth, images.left, images.full_at, *gradients, sums,
            width, height, tiles.columns, first,
            COLOR=first == 0, HELD=held, C=count, WIDTH=columns, TILE=tiles.size, CHUNK=CHUNK, SLOTTED=slotted,
            num_warps=1, enable_fp_fusion=True,
        )  # fmt: skip
    if slotted:
        slot_sums, sums = sums, torch.empty(n, columns, device=device)
        sum_slots_kernel[(n,)](
            slot_sums, lists.order, lists.slot_ends, sums,
            WIDTH=columns, PADDED=triton.next_power_of_2(columns), SLOTS=SLOTS, num_warps=1, enable_fp_fusion=True,
        )  # fmt: skip
    if more:
        own = sums[:, HEAD.value + count :].reshape(n, more, SHAPE.value)
        sums[:, : SHAPE.value] += own.sum(1)
    return sums[:, : HEAD.value + count]
