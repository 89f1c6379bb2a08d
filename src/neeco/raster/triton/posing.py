"""Posing bodies whose parts turn about hinges, as `neeco.raster.posing` defines it: a Gaussian per lane."""

import triton
import triton.language as tl

from neeco.raster.triton.geometry import quadruple, triple

# where the numbers of a body begin
SHAFT_ORIGIN, SHAFT_DIRECTION = tl.constexpr(12), tl.constexpr(15)
SPIN_END, GATE_START, GATE_WIDTH, LONGEST = tl.constexpr(18), tl.constexpr(19), tl.constexpr(20), tl.constexpr(21)
BODY, HINGE = tl.constexpr(22), tl.constexpr(8)  # how many, and of each joint: pivot, axis, angles


@triton.jit
def product(aw, ax, ay, az, bw, bx, by, bz):
    """Hamilton product."""
    return (
        aw * bw - ax * bx - ay * by - az * bz,
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
    )  # fmt: skip


@triton.jit
def three(at):
    """Three neighbours, of every lane the same."""
    return tl.load(at), tl.load(at + 1), tl.load(at + 2)


@triton.jit
def turn_point(px, py, pz, nx, ny, nz, sine, cosine, x, y, z):
    """Points turned about a pivot p and an axis n (Rodrigues)."""
    ax, ay, az = x - px, y - py, z - pz
    along = (nx * ax + ny * ay + nz * az) * (1 - cosine)
    return (
        px + cosine * ax + sine * (ny * az - nz * ay) + along * nx,
        py + cosine * ay + sine * (nz * ax - nx * az) + along * ny,
        pz + cosine * az + sine * (nx * ay - ny * ax) + along * nz,
    )  # fmt: skip


@triton.jit
def turn(pivot, axis, angle, x, y, z, qw, qx, qy, qz):
    """Points and quaternions turned about a line by angles."""
    px, py, pz = three(pivot)
    nx, ny, nz = three(axis)
    s, c = tl.sin(0.5 * angle), tl.cos(0.5 * angle)
    x, y, z = turn_point(px, py, pz, nx, ny, nz, 2 * s * c, 1 - 2 * s * s, x, y, z)
    qw, qx, qy, qz = product(c, s * nx, s * ny, s * nz, qw, qx, qy, qz)
    return x, y, z, qw, qx, qy, qz


@triton.jit
def pose_row(pose):
    """The pose's rotation as a row of Shepperd's symmetric matrix: which one, its four numbers, the signed length that
    makes them a unit quaternion with w >= 0."""
    m00, m01, m02 = tl.load(pose), tl.load(pose + 1), tl.load(pose + 2)
    m10, m11, m12 = tl.load(pose + 4), tl.load(pose + 5), tl.load(pose + 6)
    m20, m21, m22 = tl.load(pose + 8), tl.load(pose + 9), tl.load(pose + 10)
    d0, d1, d2, d3 = 1 + m00 + m11 + m22, 1 + m00 - m11 - m22, 1 - m00 + m11 - m22, 1 - m00 - m11 + m22
    row = tl.where(d1 > d0, 1, 0)
    best = tl.maximum(d0, d1)
    row = tl.where(d2 > best, 2, row)
    best = tl.maximum(best, d2)
    row = tl.where(d3 > best, 3, row)
    x, y, z = m21 - m12, m02 - m20, m10 - m01
    xy, xz, yz = m01 + m10, m02 + m20, m12 + m21
    a = tl.where(row == 0, d0, tl.where(row == 1, x, tl.where(row == 2, y, z)))
    b = tl.where(row == 0, x, tl.where(row == 1, d1, tl.where(row == 2, xy, xz)))
    c = tl.where(row == 0, y, tl.where(row == 1, xy, tl.where(row == 2, d2, yz)))
    d = tl.where(row == 0, z, tl.where(row == 1, xz, tl.where(row == 2, yz, d3)))
    length = tl.sqrt(a * a + b * b + c * c + d * d)
    return row, a, b, c, d, tl.where(a < 0, 0.0 - length, length)


@triton.jit
def resting(means, quats, g, inside):
    """Means, unit quaternions and the length they had."""
    x, y, z = triple(means, g, inside)
    qw, qx, qy, qz = quadruple(quats, g, inside)
    norm = tl.maximum(tl.sqrt(qw * qw + qx * qx + qy * qy + qz * qz), 1e-12)
    return x, y, z, qw / norm, qx / norm, qy / norm, qz / norm, norm


@triton.jit
def along_shaft(numbers, x, y, z):
    ox, oy, oz = three(numbers + SHAFT_ORIGIN)
    dx, dy, dz = three(numbers + SHAFT_DIRECTION)
    return (x - ox) * dx + (y - oy) * dy + (z - oz) * dz


@triton.jit
def softmax_of(logits, g, inside, JOINTS: tl.constexpr, LOGITS: tl.constexpr):
    """The greatest logit and the sum of all exponentials less by it."""
    greatest = tl.load(logits + g * LOGITS, inside, other=0.0)
    for part in tl.static_range(1, 1 + 2 * JOINTS):
        greatest = tl.maximum(greatest, tl.load(logits + g * LOGITS + part, inside, other=0.0))
    total = 0.0 * greatest
    for part in tl.static_range(1 + 2 * JOINTS):
        total += tl.exp(tl.load(logits + g * LOGITS + part, inside, other=0.0) - greatest)
    return greatest, total


@triton.jit
def share_of(logits, part, g, inside, greatest, total, LOGITS: tl.constexpr):
    return tl.exp(tl.load(logits + g * LOGITS + part, inside, other=0.0) - greatest) / total


@triton.jit
def pull_of(logits, numbers, joint, g, inside, greatest, total, gate, LOGITS: tl.constexpr):
    """A joint's two parts' shares of turning, and the angle they come to."""
    first = share_of(logits, 1 + 2 * joint, g, inside, greatest, total, LOGITS) * gate
    second = share_of(logits, 2 + 2 * joint, g, inside, greatest, total, LOGITS) * gate
    angles = numbers + BODY + joint * HINGE + 6
    return first, second, first * tl.load(angles) + second * tl.load(angles + 1)


@triton.jit
def gate_of(numbers, x, y, z):
    return 1 / (
        1 + tl.exp((tl.load(numbers + GATE_START) - along_shaft(numbers, x, y, z)) / tl.load(numbers + GATE_WIDTH))
    )


@triton.jit
def spin_of(numbers, roll, x, y, z):
    return tl.where(along_shaft(numbers, x, y, z) < tl.load(numbers + SPIN_END), roll, 0.0)


@triton.jit(do_not_specialize=["roll", "start", "count"])
def pose_kernel(
    means, quats, log_scales, logits, numbers, roll, to_means, to_quats, to_scales, to_frames, start, count,
    SPINS: tl.constexpr, JOINTS: tl.constexpr, LOGITS: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """One body; numbers None: it stands still."""
    lane = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    inside = lane < count
    g = start + lane
    sx, sy, sz = triple(log_scales, g, inside)
    sx, sy, sz = tl.exp(sx), tl.exp(sy), tl.exp(sz)
    if numbers is None:
        x, y, z = triple(means, g, inside)
        qw, qx, qy, qz = quadruple(quats, g, inside)
        fw, fx, fy, fz = 1.0 + 0.0 * sx, 0.0 * sx, 0.0 * sx, 0.0 * sx
    else:
        x, y, z, qw, qx, qy, qz, _ = resting(means, quats, g, inside)
        rw, rx, ry, rz = qw, qx, qy, qz
        if JOINTS > 0:
            gate = gate_of(numbers, x, y, z)
            greatest, total = softmax_of(logits, g, inside, JOINTS, LOGITS)
            turning = 0.0 * gate
        if SPINS:
            x, y, z, qw, qx, qy, qz = turn(
                numbers + SHAFT_ORIGIN, numbers + SHAFT_DIRECTION, spin_of(numbers, roll, x, y, z),
                x, y, z, qw, qx, qy, qz,
            )  # fmt: skip
        for joint in tl.static_range(JOINTS):
            first, second, angle = pull_of(logits, numbers, joint, g, inside, greatest, total, gate, LOGITS)
            turning += first + second
            hinge = numbers + BODY + joint * HINGE
            x, y, z, qw, qx, qy, qz = turn(hinge, hinge + 3, angle, x, y, z, qw, qx, qy, qz)
        if JOINTS > 0:
            longest = tl.load(numbers + LONGEST) / tl.maximum(turning, 1e-6)
            sx, sy, sz = tl.minimum(sx, longest), tl.minimum(sy, longest), tl.minimum(sz, longest)
        _, a, b, c, d, length = pose_row(numbers)
        qw, qx, qy, qz = product(a / length, b / length, c / length, d / length, qw, qx, qy, qz)
        fw, fx, fy, fz = product(qw, qx, qy, qz, rw, 0.0 - rx, 0.0 - ry, 0.0 - rz)
        x, y, z = (
            tl.load(numbers) * x + tl.load(numbers + 1) * y + tl.load(numbers + 2) * z + tl.load(numbers + 3),
            tl.load(numbers + 4) * x + tl.load(numbers + 5) * y + tl.load(numbers + 6) * z + tl.load(numbers + 7),
            tl.load(numbers + 8) * x + tl.load(numbers + 9) * y + tl.load(numbers + 10) * z + tl.load(numbers + 11),
        )
    put_three(to_means + g * 3, x, y, z, inside)
    put_three(to_scales + g * 3, sx, sy, sz, inside)
    put_four(to_quats + g * 4, qw, qx, qy, qz, inside)
    put_four(to_frames + g * 4, fw, fx, fy, fz, inside)


@triton.jit
def put_three(at, a, b, c, inside):
    tl.store(at, a, inside)
    tl.store(at + 1, b, inside)
    tl.store(at + 2, c, inside)


@triton.jit
def put_four(at, a, b, c, d, inside):
    tl.store(at, a, inside)
    put_three(at + 1, b, c, d, inside)
