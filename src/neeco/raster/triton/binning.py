"""Stage 2: lists of the Gaussians that each tile of the image blends, in order of depth."""

from dataclasses import dataclass

import torch
import triton
import triton.language as tl
from torch import Tensor

from neeco.base.errors import NeecoError

BLOCK = 128  # pairs per program
ELLIPSE = tl.constexpr(8)  # floats of an ellipse: x, y, half height, slope, k0, k1, peak, nothing
MAX_PAIRS = 2**31 - 1


@dataclass(frozen=True)
class Tiles:
    """Square tiles of an image."""

    size: int  # px, a power of two
    width: int  # px of the image
    height: int

    @property
    def columns(self) -> int:
        return -(-self.width // self.size)

    @property
    def count(self) -> int:
        return self.columns * -(-self.height // self.size)


@dataclass(frozen=True)
class Lists:
    """The Gaussians of every tile, near to far, equal depths by index, concatenated.

    Every (tile, Gaussian) pair has a slot: slots follow `order`, so that those of one Gaussian are contiguous.
    """

    gaussians: Tensor  # [pairs] int32
    slots: Tensor  # [pairs] int64
    starts: Tensor  # [tiles + 1] int32: start of each tile's part
    order: Tensor  # [N] int64: Gaussians, near to far
    slot_ends: Tensor  # [N] int64: end of the slots of the Gaussian at this position of `order`


@triton.jit
def pixel_range(low, high, size):
    """Return the first and last pixel, as floats, whose centre lies in [low, high] (with 1e-3 px margin) in the
    image."""
    first = tl.ceil(tl.minimum(tl.maximum(low - 0.501, 0.0), size))
    last = tl.floor(tl.maximum(tl.minimum(high - 0.499, size - 1.0), -1.0))
    return first, last


@triton.jit
def tile_rows(y, half_height, height, TILE: tl.constexpr):
    """Return the first and last row of tiles that an ellipse may touch; last < first: none."""
    first, last = pixel_range(y - half_height, y + half_height, height)
    low, high = first.to(tl.int32) // TILE, tl.maximum(last, 0.0).to(tl.int32) // TILE
    return low, tl.where(last >= first, high, low - 1)


@triton.jit
def tile_columns(row, x, y, half_height, slope, k0, k1, peak, width, height, TILE: tl.constexpr):
    """Return the first column and the number of columns of tiles that an ellipse covers in a row of tiles.

    At d px below its centre the ellipse spans slope d -+ sqrt(k0 - k1 d^2); it is widest at d = +-peak.
    """
    top = (row * TILE).to(tl.float32) + 0.5 - y
    bottom = tl.minimum((row * TILE + TILE).to(tl.float32), height) - 0.5 - y
    low = tl.maximum(top, 0.0 - half_height)
    high = tl.maximum(tl.minimum(bottom, half_height), low)
    at_right = tl.minimum(tl.maximum(peak, low), high)
    at_left = tl.minimum(tl.maximum(0.0 - peak, low), high)
    right = x + slope * at_right + tl.sqrt(tl.maximum(k0 - k1 * at_right * at_right, 0.0))
    left = x + slope * at_left - tl.sqrt(tl.maximum(k0 - k1 * at_left * at_left, 0.0))
    first, last = pixel_range(left, right, width)
    column = first.to(tl.int32) // TILE
    columns = tl.maximum(last, 0.0).to(tl.int32) // TILE - column + 1
    return column, tl.where(last >= first, columns, 0)


@triton.jit(do_not_specialize=["count", "pairs", "steps", "columns"])
def list_kernel(
    ellipses, counts, order, slot_ends, tiles, gaussians, count, pairs, steps, columns, nowhere, width, height,
    TILE: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Write tile and Gaussian of every slot; a slot without a tile gets `nowhere`.

    Lanes are slots, not Gaussians: one that covers the image is as much work as many that cover a pixel.
    """
    slot = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    live = slot < pairs
    low = tl.zeros([BLOCK], tl.int32)
    high = low + count
    for _ in range(steps):  # binary search: the first Gaussian of the order whose slots end after this one
        middle = (low + high) // 2
        behind = tl.load(slot_ends + middle, live & (middle < count), other=0) > slot
        high = tl.where(behind, middle, high)
        low = tl.where(behind, low, middle + 1)
    live = live & (low < count)
    gaussian = tl.load(order + low, live, other=0)
    rest = tl.load(counts + gaussian, live, other=0) - (tl.load(slot_ends + low, live, other=0) - slot).to(tl.int32)
    at = ellipses + gaussian * ELLIPSE
    x, y = tl.load(at, live, other=0.0), tl.load(at + 1, live, other=0.0)
    half_height, slope = tl.load(at + 2, live, other=0.0), tl.load(at + 3, live, other=0.0)
    k0, k1 = tl.load(at + 4, live, other=0.0), tl.load(at + 5, live, other=0.0)
    peak = tl.load(at + 6, live, other=0.0)
    row, last_row = tile_rows(y, half_height, height, TILE)
    tile = tl.zeros([BLOCK], tl.int32) + nowhere
    searching = live & (row <= last_row)
    more = tl.max(searching.to(tl.int32), axis=0) > 0
    while more:
        column, here = tile_columns(row, x, y, half_height, slope, k0, k1, peak, width, height, TILE)
        hit = searching & (rest < here)
        tile = tl.where(hit, row * columns + column + rest, tile)
        rest -= here
        row += 1
        searching = searching & (rest >= 0) & (row <= last_row)
        more = tl.max(searching.to(tl.int32), axis=0) > 0
    inside = slot < pairs
    tl.store(tiles + slot, tile.to(tiles.dtype.element_ty), inside)
    tl.store(gaussians + slot, gaussian.to(tl.int32), inside)


def list_per_tile(ellipses: Tensor, counts: Tensor, depths: Tensor, tiles: Tiles) -> Lists:
    """Return lists of the Gaussians whose `ellipses` [N, 8] px touch `counts` [N] int32 tiles, by `depths` [N].

    Waits for the device once, for the number of pairs.
    """
    device = depths.device
    order = torch.sort(depths, stable=True).indices
    slot_ends = torch.cumsum(counts[order], 0)
    pairs = int(slot_ends[-1]) if len(counts) else 0
    if pairs > MAX_PAIRS:
        raise NeecoError(
            f"rasterize: triton: {pairs} pairs of a tile and a Gaussian are too many; render a smaller image"
        )
    # sorting 16-bit keys takes half the passes
    small = torch.int16 if tiles.count < 2**15 else torch.int32
    tile_of = torch.empty(pairs, dtype=small, device=device)
    gaussian_of = torch.empty(pairs, dtype=torch.int32, device=device)
    if pairs:
        list_kernel[(triton.cdiv(pairs, BLOCK),)](
            ellipses, counts, order, slot_ends, tile_of, gaussian_of, len(counts), pairs, len(counts).bit_length(),
            tiles.columns, tiles.count, float(tiles.width), float(tiles.height),
            TILE=tiles.size, BLOCK=BLOCK, num_warps=4, enable_fp_fusion=True,
        )  # fmt: skip
    tile_of, slots = torch.sort(tile_of, stable=True)
    numbers = torch.arange(tiles.count + 1, dtype=small, device=device)
    starts = torch.searchsorted(tile_of, numbers, out_int32=True)
    return Lists(gaussian_of[slots], slots, starts, order, slot_ends)
