"""Functions of the projection and its gradient, one Gaussian per lane: from the world to the image."""

import triton
import triton.language as tl

LOW_PASS = tl.constexpr(0.3)  # px^2 added to projected covariances
FIELD_MARGIN = tl.constexpr(0.3)  # share of half the field of view by which the linearisation point may lie outside
LOG2_E = tl.constexpr(1.4426950408889634)
LARGEST = tl.constexpr(3.4028234663852886e38)


@triton.jit
def finite(x):
    """Whether x is neither NaN nor infinite."""
    return tl.abs(x) <= LARGEST


@triton.jit
def rotation_matrix(w, x, y, z):
    """Return the nine entries, row by row, of the matrix of unit quaternions."""
    return (
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    )  # fmt: skip


@triton.jit
def view_rotation(pose):
    """Return the rotation camera_from_world, row by row, of a pose [4, 4] world_from_camera."""
    return (
        tl.load(pose), tl.load(pose + 4), tl.load(pose + 8),
        tl.load(pose + 1), tl.load(pose + 5), tl.load(pose + 9),
        tl.load(pose + 2), tl.load(pose + 6), tl.load(pose + 10),
    )  # fmt: skip


@triton.jit
def depth_of(pose, wx, wy, wz):
    """Return the depth, computed in float64 in a fixed order, rounded once: every backend sorts the same numbers.

    Products of float32 numbers are exact in float64, so it does not matter whether the compiler fuses them.
    """
    ax, ay, az = tl.load(pose + 2).to(tl.float64), tl.load(pose + 6).to(tl.float64), tl.load(pose + 10).to(tl.float64)
    cx, cy, cz = tl.load(pose + 3).to(tl.float64), tl.load(pose + 7).to(tl.float64), tl.load(pose + 11).to(tl.float64)
    offset = 0.0 - ax * cx - ay * cy - az * cz
    depth = ((ax * wx.to(tl.float64) + ay * wy.to(tl.float64)) + az * wz.to(tl.float64)) + offset
    return depth.to(tl.float32)


@triton.jit
def camera_mean(pose, wx, wy, wz):
    """Return means in the camera's frame, mm."""
    r0, r1, r2, r3, r4, r5, _, _, _ = view_rotation(pose)
    cx, cy, cz = tl.load(pose + 3), tl.load(pose + 7), tl.load(pose + 11)
    x = r0 * wx + r1 * wy + r2 * wz - (r0 * cx + r1 * cy + r2 * cz)
    y = r3 * wx + r4 * wy + r5 * wz - (r3 * cx + r4 * cy + r5 * cz)
    return x, y, depth_of(pose, wx, wy, wz)


@triton.jit
def field_slope(slope, size, focal, middle):
    """Return x / z (or y / z) clamped to the field of view and its margin, and whether it was outside."""
    margin = size / focal * (FIELD_MARGIN * 0.5)
    low, high = (0.0 - middle) / focal - margin, (size - middle) / focal + margin
    inside = tl.minimum(tl.maximum(slope, low), high)
    return inside, inside != slope


@triton.jit
def image_rows(pose, inverse_z, slope_x, slope_y, fx, fy):
    """T [2, 3] = J camera_from_world, J the projection linearised at the slopes."""
    r0, r1, r2, r3, r4, r5, r6, r7, r8 = view_rotation(pose)
    jx, jy = fx * inverse_z, fy * inverse_z
    return (
        jx * (r0 - slope_x * r6), jx * (r1 - slope_x * r7), jx * (r2 - slope_x * r8),
        jy * (r3 - slope_y * r6), jy * (r4 - slope_y * r7), jy * (r5 - slope_y * r8),
    )  # fmt: skip


@triton.jit
def shape_row(t0, t1, t2, r0, r1, r2, r3, r4, r5, r6, r7, r8, sx, sy, sz):
    """Return a row of U = T R S."""
    return (
        (t0 * r0 + t1 * r3 + t2 * r6) * sx,
        (t0 * r1 + t1 * r4 + t2 * r7) * sy,
        (t0 * r2 + t1 * r5 + t2 * r8) * sz,
    )


@triton.jit
def covariance(u0, u1, u2, u3, u4, u5):
    """xx, xy, yy of U U^T with the low-pass, px^2, and its determinant."""
    xx = u0 * u0 + u1 * u1 + u2 * u2
    yy = u3 * u3 + u4 * u4 + u5 * u5
    xy = u0 * u3 + u1 * u4 + u2 * u5
    # det(U U^T) is the sum of the squared minors of U: no cancellation for needles.
    a, b, c = u0 * u4 - u1 * u3, u0 * u5 - u2 * u3, u1 * u5 - u2 * u4
    determinant = a * a + b * b + c * c + (xx + yy) * LOW_PASS + LOW_PASS * LOW_PASS
    return xx + LOW_PASS, xy, yy + LOW_PASS, determinant


@triton.jit
def projected(means, quats, scales, pose, g, wanted, fx, fy, cx, cy, width, height, near):
    """Means, world and camera; 1 / z; slopes and whether clamped; T; unit quaternion and 1 / norm; R; scales; U.

    Where nothing is `wanted`, or the mean is nearer than `near`, the quaternion is not a number.
    """
    wx, wy, wz = triple(means, g, wanted)
    x, y, z = camera_mean(pose, wx, wy, wz)
    iz = 1.0 / z
    slope_x, clamped_x = field_slope(x * iz, width, fx, cx)
    slope_y, clamped_y = field_slope(y * iz, height, fy, cy)
    t0, t1, t2, t3, t4, t5 = image_rows(pose, iz, slope_x, slope_y, fx, fy)
    wanted = wanted & (z > near)
    qw, qx, qy, qz = quadruple(quats, g, wanted)
    inorm = 1.0 / tl.sqrt(qw * qw + qx * qx + qy * qy + qz * qz)
    qw, qx, qy, qz = qw * inorm, qx * inorm, qy * inorm, qz * inorm
    r0, r1, r2, r3, r4, r5, r6, r7, r8 = rotation_matrix(qw, qx, qy, qz)
    sx, sy, sz = triple(scales, g, wanted)
    u0, u1, u2 = shape_row(t0, t1, t2, r0, r1, r2, r3, r4, r5, r6, r7, r8, sx, sy, sz)
    u3, u4, u5 = shape_row(t3, t4, t5, r0, r1, r2, r3, r4, r5, r6, r7, r8, sx, sy, sz)
    return (
        wx, wy, wz, x, y, z, iz, slope_x, slope_y, clamped_x, clamped_y, t0, t1, t2, t3, t4, t5,
        qw, qx, qy, qz, inorm, r0, r1, r2, r3, r4, r5, r6, r7, r8, sx, sy, sz, u0, u1, u2, u3, u4, u5,
    )  # fmt: skip


@triton.jit
def headlight(falloff, vignette, x, y, z, slope_x, slope_y):
    """The light's factor, the binary logarithm of distance / 100 mm, and t of the vignette."""
    log2_distance = 0.5 * tl.log2((x * x + y * y + z * z) * 1e-4)
    t = slope_x * slope_x + slope_y * slope_y
    exponent = (tl.load(vignette) * t + tl.load(vignette + 1) * t * t) * LOG2_E - falloff * log2_distance
    factor = tl.exp2(tl.minimum(tl.maximum(exponent, -125.0), 125.0))
    return tl.where(finite(exponent), factor, float("nan")), log2_distance, t


@triton.jit
def direction(pose, wx, wy, wz):
    """Unit directions, world frame, from the camera's centre to means, and the inverse distance."""
    dx, dy, dz = wx - tl.load(pose + 3), wy - tl.load(pose + 7), wz - tl.load(pose + 11)
    inverse = 1.0 / tl.sqrt(dx * dx + dy * dy + dz * dz)
    return dx * inverse, dy * inverse, dz * inverse, inverse


@triton.jit
def triple_at(at, mask):
    """Load three consecutive numbers."""
    return tl.load(at, mask, other=0.0), tl.load(at + 1, mask, other=0.0), tl.load(at + 2, mask, other=0.0)


@triton.jit
def quadruple_at(at, mask):
    """Load four consecutive numbers."""
    a, b = tl.load(at, mask, other=0.0), tl.load(at + 1, mask, other=0.0)
    return a, b, tl.load(at + 2, mask, other=0.0), tl.load(at + 3, mask, other=0.0)


@triton.jit
def put_three(at, a, b, c, mask):
    """Store three consecutive numbers."""
    tl.store(at, a, mask)
    tl.store(at + 1, b, mask)
    tl.store(at + 2, c, mask)


@triton.jit
def put_four(at, a, b, c, d, mask):
    """Store four consecutive numbers."""
    tl.store(at, a, mask)
    put_three(at + 1, b, c, d, mask)


@triton.jit
def triple(base, index, mask):
    """Load rows of three floats."""
    return triple_at(base + index * 3, mask)


@triton.jit
def quadruple(base, index, mask):
    """Load rows of four floats."""
    return quadruple_at(base + index * 4, mask)


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
    """Store the gradient of coefficient k (0 where not visible); return dL / d basis."""
    if WANTED:
        tl.store(to_sh + 3 * k, tl.where(seen, basis * to_red, 0.0), inside)
        tl.store(to_sh + 3 * k + 1, tl.where(seen, basis * to_green, 0.0), inside)
        tl.store(to_sh + 3 * k + 2, tl.where(seen, basis * to_blue, 0.0), inside)
    red = tl.load(sh + 3 * k, seen, other=0.0)
    green = tl.load(sh + 3 * k + 1, seen, other=0.0)
    return to_red * red + to_green * green + to_blue * tl.load(sh + 3 * k + 2, seen, other=0.0)


@triton.jit
def sh_gradient(sh, to_sh, inside, seen, x, y, z, to_red, to_green, to_blue, COUNT: tl.constexpr, WANTED: tl.constexpr):
    """Store the harmonics' gradients; return the direction's. sh, to_sh [B]: address of a Gaussian's first harmonic."""
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


@triton.jit
def put_sum(at, value, counted):
    """Store the sum over lanes that count."""
    tl.store(at, tl.sum(tl.where(counted, value, 0.0), axis=0))


@triton.jit
def put_sums(at, a, b, c, counted):
    """Store three consecutive sums over lanes that count."""
    put_sum(at, a, counted)
    put_sum(at + 1, b, counted)
    put_sum(at + 2, c, counted)
