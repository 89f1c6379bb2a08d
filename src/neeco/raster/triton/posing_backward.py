"""The gradient of posing bodies whose parts turn about hinges: a Gaussian per lane.

One turn after the other is undone, instead of remembering what lay between them. The same inputs give the same bits.
"""

import triton
import triton.language as tl

from neeco.raster.triton.geometry import quadruple, triple
from neeco.raster.triton.posing import (
    BODY,
    HINGE,
    LONGEST,
    SHAFT_DIRECTION,
    SHAFT_ORIGIN,
    SPIN_END,
    gate_of,
    pose_row,
    product,
    pull_of,
    put_four,
    put_three,
    resting,
    share_of,
    softmax_of,
    spin_of,
    three,
    turn,
    turn_point,
)


@triton.jit
def put_sum(at, value, inside):
    tl.store(at, tl.sum(tl.where(inside, value, 0.0), axis=0))


@triton.jit
def turn_backward(pivot, axis, angle, sums_pivot, sums_axis, inside, x, y, z, qw, qx, qy, qz, gx, gy, gz, hw, hx, hy,
                  hz):  # fmt: skip
    """Points and quaternions back to before the turn, their gradients g and h too, and dL/d angle; sums of dL/d pivot
    and dL/d axis are written."""
    px, py, pz = three(pivot)
    nx, ny, nz = three(axis)
    s, c = tl.sin(0.5 * angle), tl.cos(0.5 * angle)
    sine, cosine = 2 * s * c, 1 - 2 * s * s
    x, y, z = turn_point(px, py, pz, nx, ny, nz, 0.0 - sine, cosine, x, y, z)
    qw, qx, qy, qz = product(c, 0.0 - s * nx, 0.0 - s * ny, 0.0 - s * nz, qw, qx, qy, qz)
    tw, tx, ty, tz = product(hw, hx, hy, hz, qw, 0.0 - qx, 0.0 - qy, 0.0 - qz)  # dL/d the turn's quaternion
    hw, hx, hy, hz = product(c, 0.0 - s * nx, 0.0 - s * ny, 0.0 - s * nz, hw, hx, hy, hz)
    ax, ay, az = x - px, y - py, z - pz
    cx, cy, cz = ay * gz - az * gy, az * gx - ax * gz, ax * gy - ay * gx  # arm x g
    along, to_along = nx * ax + ny * ay + nz * az, nx * gx + ny * gy + nz * gz
    to_angle = sine * (along * to_along - (ax * gx + ay * gy + az * gz)) + cosine * (nx * cx + ny * cy + nz * cz)
    to_angle += 0.5 * (c * (nx * tx + ny * ty + nz * tz) - s * tw)
    rest = 1 - cosine
    put_sum(sums_axis, sine * cx + rest * (to_along * ax + along * gx) + s * tx, inside)
    put_sum(sums_axis + 1, sine * cy + rest * (to_along * ay + along * gy) + s * ty, inside)
    put_sum(sums_axis + 2, sine * cz + rest * (to_along * az + along * gz) + s * tz, inside)
    mx = cosine * gx + sine * (gy * nz - gz * ny) + rest * to_along * nx
    my = cosine * gy + sine * (gz * nx - gx * nz) + rest * to_along * ny
    mz = cosine * gz + sine * (gx * ny - gy * nx) + rest * to_along * nz
    put_sum(sums_pivot, gx - mx, inside)
    put_sum(sums_pivot + 1, gy - my, inside)
    put_sum(sums_pivot + 2, gz - mz, inside)
    return x, y, z, qw, qx, qy, qz, mx, my, mz, hw, hx, hy, hz, to_angle


@triton.jit(do_not_specialize=["roll", "start", "count"])
def pose_backward_kernel(
    means, quats, log_scales, logits, numbers, roll, from_means, from_quats, from_scales,
    to_means, to_quats, to_log_scales, to_logits, sums, start, count,
    SPINS: tl.constexpr, JOINTS: tl.constexpr, LOGITS: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """sums [programs, 22 + 8 J]: of dL/d numbers; dL/d the pose's quaternion stands where no gradient is wanted."""
    lane = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    inside = lane < count
    g = start + lane
    gx, gy, gz = triple(from_means, g, inside)
    hw, hx, hy, hz = quadruple(from_quats, g, inside)
    sx, sy, sz = triple(log_scales, g, inside)
    sx, sy, sz = tl.exp(sx), tl.exp(sy), tl.exp(sz)
    wx, wy, wz = triple(from_scales, g, inside)
    wx, wy, wz = wx * sx, wy * sy, wz * sz
    if numbers is not None:
        own = sums + tl.program_id(0) * (BODY + JOINTS * HINGE)
        x, y, z, qw, qx, qy, qz, norm = resting(means, quats, g, inside)
        rw, rx, ry, rz = qw, qx, qy, qz
        spin = spin_of(numbers, roll, x, y, z)
        if JOINTS > 0:
            gate = gate_of(numbers, x, y, z)
            greatest, total = softmax_of(logits, g, inside, JOINTS, LOGITS)
            turning = 0.0 * gate
        if SPINS:
            x, y, z, qw, qx, qy, qz = turn(
                numbers + SHAFT_ORIGIN, numbers + SHAFT_DIRECTION, spin, x, y, z, qw, qx, qy, qz
            )  # fmt: skip
        for joint in tl.static_range(JOINTS):
            first, second, angle = pull_of(logits, numbers, joint, g, inside, greatest, total, gate, LOGITS)
            turning += first + second
            hinge = numbers + BODY + joint * HINGE
            x, y, z, qw, qx, qy, qz = turn(hinge, hinge + 3, angle, x, y, z, qw, qx, qy, qz)
        if JOINTS > 0:
            longest = tl.load(numbers + LONGEST) / tl.maximum(turning, 1e-6)
            wx = tl.where(sx < longest, wx, 0.0)
            wy = tl.where(sy < longest, wy, 0.0)
            wz = tl.where(sz < longest, wz, 0.0)
        put_pose_row(own, gx, x, y, z, inside)
        put_pose_row(own + 4, gy, x, y, z, inside)
        put_pose_row(own + 8, gz, x, y, z, inside)
        gx, gy, gz = (
            tl.load(numbers) * gx + tl.load(numbers + 4) * gy + tl.load(numbers + 8) * gz,
            tl.load(numbers + 1) * gx + tl.load(numbers + 5) * gy + tl.load(numbers + 9) * gz,
            tl.load(numbers + 2) * gx + tl.load(numbers + 6) * gy + tl.load(numbers + 10) * gz,
        )
        tw, tx, ty, tz = product(hw, hx, hy, hz, qw, 0.0 - qx, 0.0 - qy, 0.0 - qz)
        put_sum(own + SPIN_END, tw, inside)
        put_sum(own + SPIN_END + 1, tx, inside)
        put_sum(own + SPIN_END + 2, ty, inside)
        put_sum(own + SPIN_END + 3, tz, inside)
        _, a, b, c, d, length = pose_row(numbers)
        hw, hx, hy, hz = product(a / length, 0.0 - b / length, 0.0 - c / length, 0.0 - d / length, hw, hx, hy, hz)
        shared = 0.0 * gx  # sum over parts of share times dL/d share
        for undone in tl.static_range(JOINTS):
            joint = JOINTS - 1 - undone
            first, second, angle = pull_of(logits, numbers, joint, g, inside, greatest, total, gate, LOGITS)
            hinge, to_hinge = numbers + BODY + joint * HINGE, own + BODY + joint * HINGE
            x, y, z, qw, qx, qy, qz, gx, gy, gz, hw, hx, hy, hz, to_angle = turn_backward(
                hinge, hinge + 3, angle, to_hinge, to_hinge + 3, inside, x, y, z, qw, qx, qy, qz, gx, gy, gz,
                hw, hx, hy, hz,
            )  # fmt: skip
            put_sum(to_hinge + 6, to_angle * first, inside)
            put_sum(to_hinge + 7, to_angle * second, inside)
            shared += to_angle * angle
            tl.store(to_logits + g * LOGITS + 1 + 2 * joint, to_angle * tl.load(hinge + 6) * gate, inside)
            tl.store(to_logits + g * LOGITS + 2 + 2 * joint, to_angle * tl.load(hinge + 7) * gate, inside)
        if JOINTS > 0:
            tl.debug_barrier()  # what was written is read again
            tl.store(
                to_logits + g * LOGITS, 0.0 - share_of(logits, 0, g, inside, greatest, total, LOGITS) * shared, inside
            )
            for part in tl.static_range(1, 1 + 2 * JOINTS):
                to_share = tl.load(to_logits + g * LOGITS + part, inside, other=0.0) - shared
                share = share_of(logits, part, g, inside, greatest, total, LOGITS)
                tl.store(to_logits + g * LOGITS + part, share * to_share, inside)
        if SPINS:
            x, y, z, qw, qx, qy, qz, gx, gy, gz, hw, hx, hy, hz, _ = turn_backward(
                numbers + SHAFT_ORIGIN, numbers + SHAFT_DIRECTION, spin, own + SHAFT_ORIGIN, own + SHAFT_DIRECTION,
                inside, x, y, z, qw, qx, qy, qz, gx, gy, gz, hw, hx, hy, hz,
            )  # fmt: skip
        radial = rw * hw + rx * hx + ry * hy + rz * hz
        hw, hx = (hw - radial * rw) / norm, (hx - radial * rx) / norm
        hy, hz = (hy - radial * ry) / norm, (hz - radial * rz) / norm
    put_three(to_means + g * 3, gx, gy, gz, inside)
    put_three(to_log_scales + g * 3, wx, wy, wz, inside)
    put_four(to_quats + g * 4, hw, hx, hy, hz, inside)


@triton.jit
def put_pose_row(at, gradient, x, y, z, inside):
    put_sum(at, gradient * x, inside)
    put_sum(at + 1, gradient * y, inside)
    put_sum(at + 2, gradient * z, inside)
    put_sum(at + 3, gradient, inside)


@triton.jit(do_not_specialize=["programs"])
def pose_sums_kernel(sums, numbers, to_numbers, programs, WIDTH: tl.constexpr, PADDED: tl.constexpr):
    """dL/d numbers [WIDTH] from the sums of all programs, in order; the quaternion's goes to the pose it is of."""
    place = tl.arange(0, PADDED)
    total = tl.zeros((PADDED,), tl.float64)
    for program in range(programs):
        total += tl.load(sums + program * WIDTH + place, place < WIDTH, other=0.0).to(tl.float64)
    row, a, b, c, d, length = pose_row(numbers)
    t0, t1 = tl.sum(tl.where(place == SPIN_END, total, 0.0)), tl.sum(tl.where(place == SPIN_END + 1, total, 0.0))
    t2, t3 = tl.sum(tl.where(place == SPIN_END + 2, total, 0.0)), tl.sum(tl.where(place == SPIN_END + 3, total, 0.0))
    radial = (t0 * a + t1 * b + t2 * c + t3 * d) / length
    total = tl.where((place >= SPIN_END) & (place < BODY), 0.0, total)
    total += entry_terms(place, row, 0, (t0 - radial * a / length) / length)
    total += entry_terms(place, row, 1, (t1 - radial * b / length) / length)
    total += entry_terms(place, row, 2, (t2 - radial * c / length) / length)
    total += entry_terms(place, row, 3, (t3 - radial * d / length) / length)
    tl.store(to_numbers + place, total.to(tl.float32), place < WIDTH)


@triton.jit
def entry_terms(place, row, column: tl.constexpr, to_entry):
    """Where, with which sign, a gradient of an entry of Shepperd's matrix goes in the pose (rows of four)."""
    low, high = tl.minimum(row, column), tl.maximum(row, column)
    i, j = place // 4, place % 4
    turns = (i < 3) & (j < 3)
    diagonal = tl.where((low == 0) | (i == low - 1), 1.0, -1.0) * tl.where(i == j, 1.0, 0.0)
    # entry (0, k + 1) is the difference of the rotation's entries (k + 2, k + 1) and (k + 1, k + 2), modulo 3
    below, above = high % 3, (high + 1) % 3
    skewed = tl.where((i == above) & (j == below), 1.0, 0.0) - tl.where((i == below) & (j == above), 1.0, 0.0)
    both = ((i == low - 1) & (j == high - 1)) | ((i == high - 1) & (j == low - 1))
    sign = tl.where(low == high, diagonal, tl.where(low == 0, skewed, tl.where(both, 1.0, 0.0)))
    return tl.where(turns, sign, 0.0) * to_entry
