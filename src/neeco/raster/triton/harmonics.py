"""Colours from real spherical harmonics up to degree 3, constants and signs of 3D Gaussian Splatting, and gradients."""

import triton
import triton.language as tl

SH0 = tl.constexpr(0.28209479177387814)
SH1 = tl.constexpr(0.4886025119029199)
SH2 = tl.constexpr(1.0925484305920792)
SH20 = tl.constexpr(0.31539156525252005)
SH22 = tl.constexpr(0.5462742152960396)
SH33 = tl.constexpr(0.5900435899266435)
SH32 = tl.constexpr(2.890611442640554)
SH31 = tl.constexpr(0.4570457994644658)
SH30 = tl.constexpr(0.3731763325901154)
SH3Z = tl.constexpr(1.445305721320277)


@triton.jit
def sh_color(at, mask, x, y, z, COUNT: tl.constexpr):
    """One colour [B] = harmonics . basis + 0.5, not clamped; at: its first coefficients, the others 3 floats apart."""
    color = 0.5 + tl.load(at, mask, other=0.0) * SH0
    if COUNT > 1:
        color += y * -SH1 * tl.load(at + 3, mask, other=0.0)
        color += z * SH1 * tl.load(at + 6, mask, other=0.0)
        color += x * -SH1 * tl.load(at + 9, mask, other=0.0)
    if COUNT > 4:
        xx, yy, zz = x * x, y * y, z * z
        color += x * SH2 * y * tl.load(at + 12, mask, other=0.0)
        color += y * -SH2 * z * tl.load(at + 15, mask, other=0.0)
        color += (2 * zz - xx - yy) * SH20 * tl.load(at + 18, mask, other=0.0)
        color += x * -SH2 * z * tl.load(at + 21, mask, other=0.0)
        color += (xx - yy) * SH22 * tl.load(at + 24, mask, other=0.0)
        if COUNT > 9:
            color += y * -SH33 * (3 * xx - yy) * tl.load(at + 27, mask, other=0.0)
            color += x * SH32 * y * z * tl.load(at + 30, mask, other=0.0)
            color += y * -SH31 * (4 * zz - xx - yy) * tl.load(at + 33, mask, other=0.0)
            color += z * SH30 * (2 * zz - 3 * xx - 3 * yy) * tl.load(at + 36, mask, other=0.0)
            color += x * -SH31 * (4 * zz - xx - yy) * tl.load(at + 39, mask, other=0.0)
            color += z * SH3Z * (xx - yy) * tl.load(at + 42, mask, other=0.0)
            color += x * -SH33 * (xx - 3 * yy) * tl.load(at + 45, mask, other=0.0)
    return color


@triton.jit
def _coefficient(sh, to_sh, k: tl.constexpr, inside, seen, basis, to_red, to_green, to_blue, WANTED: tl.constexpr):
    """Writes the gradient of coefficient k (0 where not seen); returns dL / d basis."""
    if WANTED:
        tl.store(to_sh + 3 * k, tl.where(seen, basis * to_red, 0.0), inside)
        tl.store(to_sh + 3 * k + 1, tl.where(seen, basis * to_green, 0.0), inside)
        tl.store(to_sh + 3 * k + 2, tl.where(seen, basis * to_blue, 0.0), inside)
    red = tl.load(sh + 3 * k, seen, other=0.0)
    green = tl.load(sh + 3 * k + 1, seen, other=0.0)
    return to_red * red + to_green * green + to_blue * tl.load(sh + 3 * k + 2, seen, other=0.0)


@triton.jit
def sh_gradient(
    sh, to_sh, inside, seen, x, y, z, to_red, to_green, to_blue, COUNT: tl.constexpr, WANTED: tl.constexpr
):  # fmt: skip
    """Writes the harmonics' gradients; returns the direction's. sh, to_sh [B]: where a Gaussian's harmonics begin."""
    _coefficient(sh, to_sh, 0, inside, seen, SH0 + 0 * x, to_red, to_green, to_blue, WANTED)
    gx, gy, gz = 0 * x, 0 * x, 0 * x
    if COUNT > 1:
        gy += _coefficient(sh, to_sh, 1, inside, seen, -SH1 * y, to_red, to_green, to_blue, WANTED) * -SH1
        gz += _coefficient(sh, to_sh, 2, inside, seen, SH1 * z, to_red, to_green, to_blue, WANTED) * SH1
        gx += _coefficient(sh, to_sh, 3, inside, seen, -SH1 * x, to_red, to_green, to_blue, WANTED) * -SH1
    if COUNT > 4:
        xx, yy, zz = x * x, y * y, z * z
        w = _coefficient(sh, to_sh, 4, inside, seen, x * SH2 * y, to_red, to_green, to_blue, WANTED)
        gx += w * SH2 * y
        gy += w * SH2 * x
        w = _coefficient(sh, to_sh, 5, inside, seen, y * -SH2 * z, to_red, to_green, to_blue, WANTED)
        gy += w * -SH2 * z
        gz += w * -SH2 * y
        w = _coefficient(sh, to_sh, 6, inside, seen, (2 * zz - xx - yy) * SH20, to_red, to_green, to_blue, WANTED)
        gx += w * (-2 * SH20) * x
        gy += w * (-2 * SH20) * y
        gz += w * (4 * SH20) * z
        w = _coefficient(sh, to_sh, 7, inside, seen, x * -SH2 * z, to_red, to_green, to_blue, WANTED)
        gx += w * -SH2 * z
        gz += w * -SH2 * x
        w = _coefficient(sh, to_sh, 8, inside, seen, (xx - yy) * SH22, to_red, to_green, to_blue, WANTED)
        gx += w * (2 * SH22) * x
        gy += w * (-2 * SH22) * y
        if COUNT > 9:
            hx, hy, hz = _cubic(sh, to_sh, inside, seen, x, y, z, to_red, to_green, to_blue, WANTED)
            gx += hx
            gy += hy
            gz += hz
    return gx, gy, gz


@triton.jit
def _cubic(sh, to_sh, inside, seen, x, y, z, to_red, to_green, to_blue, WANTED: tl.constexpr):
    """`sh_gradient` of degree 3 alone."""
    xx, yy, zz = x * x, y * y, z * z
    xy, yz, xz = x * y, y * z, x * z
    b = y * -SH33 * (3 * xx - yy)
    w = _coefficient(sh, to_sh, 9, inside, seen, b, to_red, to_green, to_blue, WANTED)
    gx = w * (-6 * SH33) * xy
    gy = w * (-3 * SH33) * (xx - yy)
    w = _coefficient(sh, to_sh, 10, inside, seen, xy * SH32 * z, to_red, to_green, to_blue, WANTED)
    gx += w * SH32 * yz
    gy += w * SH32 * xz
    gz = w * SH32 * xy
    b = y * -SH31 * (4 * zz - xx - yy)
    w = _coefficient(sh, to_sh, 11, inside, seen, b, to_red, to_green, to_blue, WANTED)
    gx += w * (2 * SH31) * xy
    gy += w * -SH31 * (4 * zz - xx - 3 * yy)
    gz += w * (-8 * SH31) * yz
    b = z * SH30 * (2 * zz - 3 * xx - 3 * yy)
    w = _coefficient(sh, to_sh, 12, inside, seen, b, to_red, to_green, to_blue, WANTED)
    gx += w * (-6 * SH30) * xz
    gy += w * (-6 * SH30) * yz
    gz += w * SH30 * (6 * zz - 3 * xx - 3 * yy)
    b = x * -SH31 * (4 * zz - xx - yy)
    w = _coefficient(sh, to_sh, 13, inside, seen, b, to_red, to_green, to_blue, WANTED)
    gx += w * -SH31 * (4 * zz - 3 * xx - yy)
    gy += w * (2 * SH31) * xy
    gz += w * (-8 * SH31) * xz
    w = _coefficient(sh, to_sh, 14, inside, seen, z * SH3Z * (xx - yy), to_red, to_green, to_blue, WANTED)
    gx += w * (2 * SH3Z) * xz
    gy += w * (-2 * SH3Z) * yz
    gz += w * SH3Z * (xx - yy)
    w = _coefficient(sh, to_sh, 15, inside, seen, x * -SH33 * (xx - 3 * yy), to_red, to_green, to_blue, WANTED)
    gx += w * (-3 * SH33) * (xx - yy)
    gy += w * (6 * SH33) * xy
    return gx, gy, gz
