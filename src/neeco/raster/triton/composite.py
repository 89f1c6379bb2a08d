"""Stage 3: blending, front to back, one tile of pixels per program.

Values are separate variables, not arrays, which would be rearranged through shared memory for every Gaussian. One
program blends colour, depth and the first channels (`MAX_HELD`); further programs repeat it with the next channels.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
import triton
import triton.language as tl
from torch import Tensor

from neeco.raster.triton.binning import Lists, Tiles
from neeco.raster.triton.project import LOG2_MIN_ALPHA, RECORD, Inputs

CHUNK = 8  # Gaussians of a list between two tests whether all pixels are full; their loads overlap
MAX_HELD = tl.constexpr(4)  # channels per program
MAX_ALPHA = tl.constexpr(0.999)
MIN_TRANSMITTANCE = tl.constexpr(1e-4)
NEVER = tl.constexpr(0x7FFFFFFF)


@dataclass(frozen=True)
class Images:
    """Rendered images, and intermediate results for the gradient."""

    color: Tensor  # [H, W, 3]
    alpha: Tensor  # [H, W]
    depth: Tensor  # [H, W] mm
    channels: Tensor | None  # [H, W, C]
    left: Tensor  # [H, W] transmittance behind everything
    full_at: Tensor  # [H, W] int32: position in the tile's list of the Gaussian at which the pixel is full, or NEVER


@triton.jit
def pixels_of(tile, columns, width, height, TILE: tl.constexpr):
    """Return a tile's pixels [P]: their indices in the image, whether they are in it, and their centres."""
    lane = tl.arange(0, TILE * TILE)
    column, row = tile % columns * TILE + lane % TILE, tile // columns * TILE + lane // TILE
    inside = (column < width) & (row < height)
    return row * width + column, inside, column.to(tl.float32) + 0.5, row.to(tl.float32) + 0.5


@triton.jit
def field(record, k: tl.constexpr, listed):
    """Return number k of a record, the same for all pixels."""
    return tl.load(record + k, listed, other=0.0)


@triton.jit
def exponent_of(record, dx, dy, listed):
    """Return the binary logarithm of alpha at pixels [P]. Fused explicitly: forward and backward must agree."""
    a, b, c = field(record, 2, listed), field(record, 3, listed), field(record, 4, listed)
    return tl.fma(tl.fma(dy, c, b * dx), dy, tl.fma(a * dx, dx, field(record, 5, listed)))


@triton.jit
def write_color(color, alpha, depth, left, full_at, background, pixel, inside, red, green, blue, distance, weights,
                transmittance, stop):  # fmt: skip
    """Store the images of the program that blends colour and depth."""
    if background is not None:
        red += transmittance * tl.load(background)
        green += transmittance * tl.load(background + 1)
        blue += transmittance * tl.load(background + 2)
    tl.store(color + pixel * 3, red, inside)
    tl.store(color + pixel * 3 + 1, green, inside)
    tl.store(color + pixel * 3 + 2, blue, inside)
    tl.store(alpha + pixel, weights, inside)
    tl.store(depth + pixel, tl.where(weights > 0, distance / tl.where(weights > 0, weights, 1.0), 0.0), inside)
    tl.store(left + pixel, transmittance, inside)
    tl.store(full_at + pixel, stop, inside)


@triton.jit(do_not_specialize=["width", "height", "columns", "first"])
def composite_kernel(
    records, channels, gaussians, starts, background, color, alpha, depth, composited, left, full_at,
    width, height, columns, first,
    COLOR: tl.constexpr, HELD: tl.constexpr, C: tl.constexpr, TILE: tl.constexpr, CHUNK: tl.constexpr,
):  # fmt: skip
    """Blend the values of a tile's Gaussians; alphas as `rasterize` defines them.

    COLOR: colour, depth and all that is per pixel; HELD: so many channels, from first + 4 x the program's number on.
    """
    tile = tl.program_id(0)
    ch = first + tl.program_id(1) * MAX_HELD
    pixel, inside, x, y = pixels_of(tile, columns, width, height, TILE)
    transmittance = tl.where(inside, 1.0, 0.0)
    stop = tl.where(inside, NEVER, -1)
    red, green, blue = tl.zeros_like(x), tl.zeros_like(x), tl.zeros_like(x)
    distance, weights = tl.zeros_like(x), tl.zeros_like(x)
    c0, c1, c2, c3 = tl.zeros_like(x), tl.zeros_like(x), tl.zeros_like(x), tl.zeros_like(x)
    begin, end = tl.load(starts + tile), tl.load(starts + tile + 1)
    k = begin
    more = k < end
    while more:
        for j in tl.static_range(CHUNK):
            listed = k + j < end
            g = tl.load(gaussians + k + j, listed, other=0).to(tl.int64)
            record = records + g * RECORD
            exponent = exponent_of(record, x - field(record, 0, listed), y - field(record, 1, listed), listed)
            weight = transmittance * tl.minimum(tl.exp2(exponent), MAX_ALPHA)
            offered = (exponent >= LOG2_MIN_ALPHA) & (stop == NEVER) & listed
            takes = transmittance - weight > MIN_TRANSMITTANCE
            stop = tl.where(offered & (takes == 0), k + j - begin, stop)
            weight = tl.where(offered & takes, weight, 0.0)
            transmittance -= weight
            if COLOR:
                red += weight * field(record, 6, listed)
                green += weight * field(record, 7, listed)
                blue += weight * field(record, 8, listed)
                distance += weight * field(record, 9, listed)
                # 1 - transmittance would lose faint alphas' digits, and depth with them
                weights += weight
            values = channels if HELD == 0 else channels + g * C + ch
            if HELD > 0:
                c0 += weight * tl.load(values, listed & (ch < C), other=0.0)
            if HELD > 1:
                c1 += weight * tl.load(values + 1, listed & (ch + 1 < C), other=0.0)
            if HELD > 2:
                c2 += weight * tl.load(values + 2, listed & (ch + 2 < C), other=0.0)
            if HELD > 3:
                c3 += weight * tl.load(values + 3, listed & (ch + 3 < C), other=0.0)
        k += CHUNK
        more = (k < end) & (tl.max(stop, axis=0) == NEVER)

    if COLOR:
        write_color(color, alpha, depth, left, full_at, background, pixel, inside, red, green, blue, distance, weights,
                    transmittance, stop)  # fmt: skip
    if HELD > 0:
        to = composited + pixel.to(tl.int64) * C + ch
        tl.store(to, c0, tl.where(inside, ch, C) < C)
        if HELD > 1:
            tl.store(to + 1, c1, tl.where(inside, ch + 1, C) < C)
        if HELD > 2:
            tl.store(to + 2, c2, tl.where(inside, ch + 2, C) < C)
        if HELD > 3:
            tl.store(to + 3, c3, tl.where(inside, ch + 3, C) < C)


def composite(inputs: Inputs, records: Tensor, lists: Lists, tiles: Tiles) -> Images:
    """Blend records [N, 12] and the inputs' channels [N, C] over their background [3]."""
    device, channels, width, height = records.device, inputs.channels, tiles.width, tiles.height
    count = 0 if channels is None else channels.shape[1]
    out = Images(
        color=torch.empty(height, width, 3, device=device),
        alpha=torch.empty(height, width, device=device),
        depth=torch.empty(height, width, device=device),
        channels=None if channels is None else torch.empty(height, width, count, device=device),
        left=torch.empty(height, width, device=device),
        full_at=torch.empty(height, width, dtype=torch.int32, device=device),
    )
    for first, programs, held in groups(count):
        composite_kernel[(tiles.count, programs)](
            records, channels, lists.gaussians, lists.starts, inputs.background,
            out.color, out.alpha, out.depth, out.channels, out.left, out.full_at,
            width, height, tiles.columns, first,
            COLOR=first == 0, HELD=held, C=count, TILE=tiles.size, CHUNK=CHUNK, num_warps=2, enable_fp_fusion=True,
        )  # fmt: skip
    return out


def groups(channels: int) -> list[tuple[int, int, int]]:
    """Return launches: first channel, programs per tile, channels per program. The first launch also has the colour."""
    most = MAX_HELD.value
    rest = triton.cdiv(max(0, channels - most), most)
    return [(0, 1, min(channels, most))] + ([(most, rest, most)] if rest else [])


BACKWARD_CHUNK = 2  # Gaussians whose loads overlap in the gradient
HEAD = tl.constexpr(10)  # sums of a Gaussian without channels
SHAPE = tl.constexpr(6)  # sums of h, which is linear in the values: every group of channels has its own
SLOTS = 16  # slots added at a time


@triton.jit
def placed(vector, index, place, value):
    """Return a small vector with the sum of `value` [P] at `place`."""
    return tl.where(index == place, tl.sum(value, axis=0), vector)


@triton.jit
def wanted_colors(to_color, to_alpha, to_depth, alpha, depth, background, pixel, inside, x):
    """Return gradients of red, green, blue and of a weight by its depth; the rendered depth; the term of the
    background."""
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
    """Return the gradient of a channel, 0 beyond the last."""
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
    ch = first + tl.program_id(1) * MAX_HELD
    pixel, inside, x, y = pixels_of(tile, columns, width, height, TILE)
    stop = tl.load(full_at + pixel, inside, other=-1)
    transmittance = tl.load(left + pixel, inside, other=0.0)
    # behind: sum over the Gaussians behind of weight * (gradient . value), minus dL/dalpha * transmittance
    behind = tl.zeros_like(x)
    index = tl.arange(0, 16)
    # column of each sum: the group's own h, then the values
    to_column = tl.where(index < SHAPE, (ch // MAX_HELD - 1) * SHAPE + index + (HEAD + C), ch + index + (HEAD - SHAPE))
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
            covered = (exponent >= LOG2_MIN_ALPHA) & (k - j - begin < stop) & listed
            opacity = tl.where(covered, tl.minimum(raw, MAX_ALPHA), 0.0)
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
            h = tl.where(covered & (raw <= MAX_ALPHA), raw * (transmittance * agreement - behind * scale), 0.0)
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
def sum_slots_kernel(slot_sums, order, slot_ends, sums, WIDTH: tl.constexpr, PADDED: tl.constexpr, SLOTS: tl.constexpr):
    """Add the slots of one Gaussian per program, in a fixed order."""
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
    inputs: Inputs, records: Tensor, lists: Lists, tiles: Tiles, images: Images, gradients: Sequence[Tensor | None]
) -> Tensor:
    """Return the sums [N, 10 + C] of every Gaussian, from the gradients of colour, alpha, depth and channels.

    The same bits every time where `torch.are_deterministic_algorithms_enabled()`.
    """
    n, device, channels = records.shape[0], records.device, inputs.channels
    count = 0 if channels is None else channels.shape[1]
    # channels without a gradient need no programs
    launches = groups(0 if gradients[3] is None else count)
    more = sum(programs for _, programs, _ in launches[1:])
    columns = HEAD.value + count + more * SHAPE.value
    slotted = torch.are_deterministic_algorithms_enabled()
    sums = torch.zeros(len(lists.gaussians) if slotted else n, columns, device=device)
    for first, programs, held in launches if len(lists.gaussians) else ():
        composite_backward_kernel[(tiles.count, programs)](
            records, channels, lists.gaussians, lists.slots, lists.starts, inputs.background,
            images.alpha, images.depth, images.left, images.full_at, *gradients, sums,
            tiles.width, tiles.height, tiles.columns, first,
            COLOR=first == 0, HELD=held, C=count, WIDTH=columns, TILE=tiles.size, CHUNK=BACKWARD_CHUNK, SLOTTED=slotted,
            num_warps=1, enable_fp_fusion=True,
        )  # fmt: skip
    if slotted:
        slot_sums, sums = sums, torch.empty(n, columns, device=device)
        sum_slots_kernel[(n,)](
            slot_sums, lists.order, lists.slot_ends, sums,
            WIDTH=columns, PADDED=triton.next_power_of_2(columns), SLOTS=SLOTS, num_warps=1, enable_fp_fusion=True,
        )  # fmt: skip
    if more:
        slotted_sums = sums[:, HEAD.value + count :].reshape(n, more, SHAPE.value)
        sums[:, : SHAPE.value] += slotted_sums.sum(1)
    return sums[:, : HEAD.value + count]
