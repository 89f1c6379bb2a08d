"""Stage 1: projection of Gaussians to ellipses in the image, with the values that are blended."""

from dataclasses import dataclass, fields

import torch
import triton
import triton.language as tl
from torch import Tensor

from neeco.geometry.camera import Camera
from neeco.raster.triton.binning import ELLIPSE, Tiles, tile_columns, tile_rows
from neeco.raster.triton.geometry import (
    LOG2_E,
    covariance,
    direction,
    finite,
    headlight,
    projected,
    put_four,
    quadruple,
    rotation_matrix,
    sh_color,
)

BLOCK = 128  # Gaussians per program
RECORD = tl.constexpr(12)  # floats of a record: x, y, a, b, c, log2 of opacity, red, green, blue, depth, two unused
MIN_ALPHA = tl.constexpr(1 / 255)
LOG2_MIN_ALPHA = tl.constexpr(-7.994353436858858)


@dataclass(frozen=True, kw_only=True)
class Inputs:
    """Tensors that are rendered: float32, contiguous, on one device."""

    means: Tensor  # [N, 3] mm
    quats: Tensor  # [N, 4]
    scales: Tensor  # [N, 3] mm
    opacities: Tensor  # [N]
    sh: Tensor  # [N, K, 3]
    falloff: Tensor | None  # [N]
    channels: Tensor | None  # [N, C]
    left: Tensor | None  # [N]: share of the light that shadows leave, > 0
    vignette: Tensor | None  # [2], present with falloff
    pose: Tensor  # [4, 4] world_from_camera
    background: Tensor | None  # [3]
    frames: Tensor | None  # [N, 4]

    def __len__(self) -> int:
        return self.means.shape[0]


INPUTS = tuple(field.name for field in fields(Inputs))


@dataclass(frozen=True)
class Projected:
    """Gaussians in the image."""

    records: Tensor  # [N, 12]: exponent of alpha, binary = log2 opacity + a dx^2 + b dx dy + c dy^2
    ellipses: Tensor  # [N, 8] where alpha >= 1/255 (`binning.ELLIPSE`)
    counts: Tensor  # [N] int32: tiles touched; where 0, nothing else is written
    depths: Tensor  # [N] mm, infinite where not rendered
    radii: Tensor  # [N] px


@triton.jit
def tiles_touched(seen, x, y, half_height, slope, k0, k1, peak, width, height, TILE: tl.constexpr):
    """Return the number of tiles that each ellipse touches, 0 where not visible."""
    row, last_row = tile_rows(y, half_height, height, TILE)
    touched = tl.zeros_like(row)
    searching = seen & (row <= last_row)
    more = tl.max(searching.to(tl.int32), axis=0) > 0
    while more:
        _first, in_row = tile_columns(row, x, y, half_height, slope, k0, k1, peak, width, height, TILE)
        touched += tl.where(searching, in_row, 0)
        row += 1
        searching = searching & (row <= last_row)
        more = tl.max(searching.to(tl.int32), axis=0) > 0
    return touched


@triton.jit(do_not_specialize=["count"])
def project_kernel(
    means, quats, scales, opacities, sh, falloff, channels, left, vignette, pose, frames,
    records, ellipses, counts, depths, radii, count, fx, fy, cx, cy, width, height, near,
    SH: tl.constexpr, C: tl.constexpr, TILE: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """One Gaussian per lane."""
    g = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    inside = g < count
    (
        wx, wy, wz, x, y, z, iz, slope_x, slope_y, _, _, _, _, _, _, _, _, _, _, _, _, inorm,
        _, _, _, _, _, _, _, _, _, _, _, _, u0, u1, u2, u3, u4, u5,
    ) = projected(means, quats, scales, pose, g, inside, fx, fy, cx, cy, width, height, near)  # fmt: skip
    xx, xy, yy, determinant = covariance(u0, u1, u2, u3, u4, u5)
    inverse = 1.0 / determinant
    seen = inside & (z > near) & finite(z) & finite(iz) & finite(wx) & finite(wy) & finite(wz)
    # non-finite quaternions and scales show in the covariance; 1 / norm is 0 where its square overflows
    seen = seen & (inorm > 0) & finite(xx) & finite(yy) & finite(determinant) & finite(inverse)

    opacity = tl.load(opacities + g, seen, other=0.0)
    seen = seen & (opacity >= MIN_ALPHA)
    log2_opacity = tl.log2(tl.maximum(opacity, 1e-30))
    reach = (log2_opacity - LOG2_MIN_ALPHA) * (2.0 / LOG2_E)  # squared Mahalanobis radius of alpha = 1/255
    px, py = fx * x * iz + cx, fy * y * iz + cy
    half_width, half_height = tl.sqrt(reach * xx), tl.sqrt(reach * yy)
    seen = seen & finite(px) & finite(py) & finite(half_width) & finite(half_height)
    seen = seen & (px + half_width > 0) & (px - half_width < width)
    seen = seen & (py + half_height > 0) & (py - half_height < height)
    red, green, blue = colors(
        sh, falloff, left, vignette, frames, pose, g, seen, wx, wy, wz, x, y, z, slope_x, slope_y, SH
    )
    seen = seen & finite(red) & finite(green) & finite(blue)
    if channels is not None:
        for ch in range(C):
            seen = seen & finite(tl.load(channels + g * C + ch, seen, other=0.0))

    slope, k0, k1 = xy / yy, reach * determinant / yy, determinant / (yy * yy)
    peak = xy * tl.sqrt(reach / xx)
    touched = tiles_touched(seen, px, py, half_height, slope, k0, k1, peak, width, height, TILE)
    seen = touched > 0
    half_trace, half_gap = 0.5 * (xx + yy), 0.5 * (xx - yy)
    radius = 3.0 * tl.sqrt(half_trace + tl.sqrt(half_gap * half_gap + xy * xy))
    tl.store(counts + g, touched, inside)
    tl.store(radii + g, tl.where(seen, radius, 0.0), inside)
    tl.store(depths + g, tl.where(seen, z, float("inf")), inside)
    put_four(ellipses + g * ELLIPSE, px, py, half_height, slope, seen)
    put_four(ellipses + g * ELLIPSE + 4, k0, k1, peak, peak, seen)
    a, b, c = yy * inverse * (-0.5 * LOG2_E), xy * inverse * LOG2_E, xx * inverse * (-0.5 * LOG2_E)
    put_four(records + g * RECORD, px, py, a, b, seen)
    put_four(records + g * RECORD + 4, c, log2_opacity, red, green, seen)
    tl.store(records + g * RECORD + 8, blue, seen)
    tl.store(records + g * RECORD + 9, z, seen)


@triton.jit
def colors(sh, falloff, left, vignette, frames, pose, g, seen, wx, wy, wz, x, y, z, slope_x, slope_y, SH: tl.constexpr):
    """Return red, green and blue as rendered; NaN where any input is not finite."""
    dx, dy, dz, _ = direction(pose, wx, wy, wz)
    if frames is not None:
        f0, f1, f2, f3 = quadruple(frames, g, seen)
        seen = seen & finite(f0) & finite(f1) & finite(f2) & finite(f3)
        dx, dy, dz = turned(f0, f1, f2, f3, dx, dy, dz)
    at = sh + g * (3 * SH)
    red, green = sh_color(at, seen, dx, dy, dz, SH), sh_color(at + 1, seen, dx, dy, dz, SH)
    blue = sh_color(at + 2, seen, dx, dy, dz, SH)
    # maximum() may turn NaN into 0
    all_finite = seen & finite(red) & finite(green) & finite(blue)
    light = tl.where(all_finite, 1.0, float("nan"))
    if falloff is not None:
        factor, _, _ = headlight(tl.load(falloff + g, seen, other=0.0), vignette, x, y, z, slope_x, slope_y)
        light = light * factor
    if left is not None:
        light = light * tl.load(left + g, seen, other=1.0)
        light = tl.where(finite(light), light, float("nan"))  # black would stay black under an infinite one
    return tl.maximum(red, 0.0) * light, tl.maximum(green, 0.0) * light, tl.maximum(blue, 0.0) * light


@triton.jit
def turned(qw, qx, qy, qz, x, y, z):
    """Return vectors in frames of unit quaternions, world_from_frame: by the transposed matrix."""
    r0, r1, r2, r3, r4, r5, r6, r7, r8 = rotation_matrix(qw, qx, qy, qz)
    return r0 * x + r3 * y + r6 * z, r1 * x + r4 * y + r7 * z, r2 * x + r5 * y + r8 * z


def project(inputs: Inputs, camera: Camera, tiles: Tiles) -> Projected:
    """Project and light every Gaussian that touches the image (EWA splatting, Zwicker et al. 2001)."""
    n, device = len(inputs), inputs.means.device
    out = Projected(
        records=torch.empty(n, RECORD.value, device=device),
        ellipses=torch.empty(n, ELLIPSE.value, device=device),
        counts=torch.empty(n, dtype=torch.int32, device=device),
        depths=torch.empty(n, device=device),
        radii=torch.empty(n, device=device),
    )
    channels = 0 if inputs.channels is None else inputs.channels.shape[1]
    if n:
        project_kernel[(triton.cdiv(n, BLOCK),)](
            inputs.means, inputs.quats, inputs.scales, inputs.opacities, inputs.sh, inputs.falloff, inputs.channels,
            inputs.left, inputs.vignette, inputs.pose, inputs.frames,
            out.records, out.ellipses, out.counts, out.depths, out.radii,
            n, camera.fx, camera.fy, camera.cx, camera.cy, float(camera.width), float(camera.height), camera.near,
            SH=inputs.sh.shape[1], C=channels, TILE=tiles.size, BLOCK=BLOCK, num_warps=4, enable_fp_fusion=True,
        )  # fmt: skip
    return out
