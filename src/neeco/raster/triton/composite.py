"""Stage 3: blending, front to back, one tile of pixels per program.

Values are named one by one, not held in arrays: those would be laid out anew for every Gaussian, through shared memory.
One program blends colour, depth and the first channels (`HELD_MOST`); others do again the same with the next ones.
"""

from dataclasses import dataclass

import torch
import triton
import triton.language as tl
from torch import Tensor

from neeco.raster.triton.binning import Lists, Tiles
from neeco.raster.triton.project import LOG2_FAINTEST, RECORD

CHUNK = 8  # Gaussians of a list between two looks at whether all pixels are full; their loads overlap
HELD_MOST = tl.constexpr(4)  # channels per program
OPAQUE = tl.constexpr(0.999)
FULL = tl.constexpr(1e-4)
NEVER = tl.constexpr(0x7FFFFFFF)


@dataclass(frozen=True)
class Images:
    """What was drawn, and what the gradient wants to know of it."""

    color: Tensor  # [H, W, 3]
    alpha: Tensor  # [H, W]
    depth: Tensor  # [H, W] mm
    channels: Tensor | None  # [H, W, C]
    left: Tensor  # [H, W] transmittance behind everything
    full_at: Tensor  # [H, W] int32: place in the tile's list of the Gaussian that found the pixel full, or NEVER


@triton.jit
def pixels_of(tile, columns, width, height, TILE: tl.constexpr):
    """A tile's pixels [P]: their numbers in the image, whether they are in it, and their centres."""
    lane = tl.arange(0, TILE * TILE)
    column, row = tile % columns * TILE + lane % TILE, tile // columns * TILE + lane // TILE
    inside = (column < width) & (row < height)
    return row * width + column, inside, column.to(tl.float32) + 0.5, row.to(tl.float32) + 0.5


@triton.jit
def field(record, k: tl.constexpr, listed):
    """Number k of a record, one for all pixels."""
    return tl.load(record + k, listed, other=0.0)


@triton.jit
def exponent_of(record, dx, dy, listed):
    """Binary logarithm of alpha at pixels [P]. Fused by hand: the gradient must decide as the image did."""
    a, b, c = field(record, 2, listed), field(record, 3, listed), field(record, 4, listed)
    return tl.fma(tl.fma(dy, c, b * dx), dy, tl.fma(a * dx, dx, field(record, 5, listed)))


@triton.jit
def write_color(color, alpha, depth, left, full_at, background, pixel, inside, red, green, blue, distance, weights,
                transmittance, stop):  # fmt: skip
    """The images of the program that blends colour and depth."""
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
    records, channels, gaussians, starts, background, color, alpha, depth, drawn, left, full_at,
    width, height, columns, first,
    COLOR: tl.constexpr, HELD: tl.constexpr, C: tl.constexpr, TILE: tl.constexpr, CHUNK: tl.constexpr,
):  # fmt: skip
    """Blends the values of a tile's Gaussians; alphas as `api.rasterize` defines them.

    COLOR: colour, depth and all that is per pixel; HELD: so many channels, from first + 4 x the program's number on.
    """
    tile = tl.program_id(0)
    ch = first + tl.program_id(1) * HELD_MOST
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
            weight = transmittance * tl.minimum(tl.exp2(exponent), OPAQUE)
            offered = (exponent >= LOG2_FAINTEST) & (stop == NEVER) & listed
            takes = transmittance - weight > FULL
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
        to = drawn + pixel.to(tl.int64) * C + ch
        tl.store(to, c0, tl.where(inside, ch, C) < C)
        if HELD > 1:
            tl.store(to + 1, c1, tl.where(inside, ch + 1, C) < C)
        if HELD > 2:
            tl.store(to + 2, c2, tl.where(inside, ch + 2, C) < C)
        if HELD > 3:
            tl.store(to + 3, c3, tl.where(inside, ch + 3, C) < C)


def composite(
    records: Tensor, channels: Tensor | None, lists: Lists, background: Tensor | None, tiles: Tiles,
    width: int, height: int,
) -> Images:  # fmt: skip
    """Blend records [N, 12] and channels [N, C] over the background [3]."""
    device = records.device
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
            records, channels, lists.gaussians, lists.starts, background,
            out.color, out.alpha, out.depth, out.channels, out.left, out.full_at,
            width, height, tiles.columns, first,
            COLOR=first == 0, HELD=held, C=count, TILE=tiles.size, CHUNK=CHUNK, num_warps=2, enable_fp_fusion=True,
        )  # fmt: skip
    return out


def groups(channels: int) -> list[tuple[int, int, int]]:
    """Launches: first channel, programs per tile, channels per program. The first launch has the colour, too."""
    most = HELD_MOST.value
    rest = triton.cdiv(max(0, channels - most), most)
    return [(0, 1, min(channels, most))] + ([(most, rest, most)] if rest else [])
