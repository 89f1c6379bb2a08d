"""Posing of articulated bodies, as `neeco.raster.articulated` defines it: a Gaussian per lane."""

from collections.abc import Sequence

import torch
import triton
import triton.language as tl
from torch import Tensor

from neeco.raster.triton.geometry import put_four, put_sum, put_sums, put_three, quadruple, triple
from neeco.raster.triton.ready import working_on

# offsets into the numbers of a body
SHAFT_ORIGIN, SHAFT_DIRECTION = tl.constexpr(12), tl.constexpr(15)
SPIN_END, GATE_START, GATE_WIDTH, LONGEST = tl.constexpr(18), tl.constexpr(19), tl.constexpr(20), tl.constexpr(21)
BODY, VALUES = (
    tl.constexpr(22),
    tl.constexpr(6),
)  # for a body without joints; per joint: origin, axis, link values


@triton.jit
def product(aw, ax, ay, az, bw, bx, by, bz):
    """Hamilton product."""
    return (
        aw * bw - ax * bx - ay * by - az * bz,
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
    )


@triton.jit
def three(at):
    """Load three consecutive numbers, the same for every lane."""
    return tl.load(at), tl.load(at + 1), tl.load(at + 2)


@triton.jit
def turn_point(px, py, pz, nx, ny, nz, sine, cosine, x, y, z):
    """Return points turned about a pivot p and an axis n (Rodrigues)."""
    ax, ay, az = x - px, y - py, z - pz
    along = (nx * ax + ny * ay + nz * az) * (1 - cosine)
    return (
        px + cosine * ax + sine * (ny * az - nz * ay) + along * nx,
        py + cosine * ay + sine * (nz * ax - nx * az) + along * ny,
        pz + cosine * az + sine * (nx * ay - ny * ax) + along * nz,
    )


@triton.jit
def turn(pivot, axis, angle, x, y, z, qw, qx, qy, qz):
    """Return points and quaternions turned about a line by angles."""
    px, py, pz = three(pivot)
    nx, ny, nz = three(axis)
    s, c = tl.sin(0.5 * angle), tl.cos(0.5 * angle)
    x, y, z = turn_point(px, py, pz, nx, ny, nz, 2 * s * c, 1 - 2 * s * s, x, y, z)
    qw, qx, qy, qz = product(c, s * nx, s * ny, s * nz, qw, qx, qy, qz)
    return x, y, z, qw, qx, qy, qz


@triton.jit
def pose_row(pose):
    """Return the pose's rotation as a row of Shepperd's symmetric matrix: its index, its four numbers, and the signed
    length that normalises them to a unit quaternion with w >= 0."""
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
    """Return means, unit quaternions and their original length."""
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
def softmax_of(logits, g, inside, LINKS: tl.constexpr, LOGITS: tl.constexpr):
    """Return the maximum logit and the sum of exponentials relative to it (log-sum-exp)."""
    greatest = tl.load(logits + g * LOGITS, inside, other=0.0)
    for link in tl.static_range(1, LINKS):
        greatest = tl.maximum(greatest, tl.load(logits + g * LOGITS + link, inside, other=0.0))
    total = 0.0 * greatest
    for link in tl.static_range(LINKS):
        total += tl.exp(tl.load(logits + g * LOGITS + link, inside, other=0.0) - greatest)
    return greatest, total


@triton.jit
def share_of(logits, link, g, inside, greatest, total, LOGITS: tl.constexpr):
    return tl.exp(tl.load(logits + g * LOGITS + link, inside, other=0.0) - greatest) / total


@triton.jit
def moving_of(logits, g, inside, greatest, total, gate, LINKS: tl.constexpr, LOGITS: tl.constexpr):
    """Return the share of a Gaussian that moves with any link."""
    moving = 0.0 * gate
    for link in tl.static_range(1, LINKS):
        moving += share_of(logits, link, g, inside, greatest, total, LOGITS) * gate
    return moving


@triton.jit
def amount_of(logits, joint, g, inside, greatest, total, gate, LINKS: tl.constexpr, LOGITS: tl.constexpr):
    """Return the angle or distance by which a joint moves a Gaussian."""
    amount = 0.0 * gate
    for link in tl.static_range(1, LINKS):
        share = share_of(logits, link, g, inside, greatest, total, LOGITS) * gate
        amount += share * tl.load(joint + VALUES + link - 1)
    return amount


@triton.jit
def slide(axis, amount, x, y, z):
    nx, ny, nz = three(axis)
    return x + amount * nx, y + amount * ny, z + amount * nz


@triton.jit
def gate_of(numbers, x, y, z):
    return 1 / (
        1 + tl.exp((tl.load(numbers + GATE_START) - along_shaft(numbers, x, y, z)) / tl.load(numbers + GATE_WIDTH))
    )


@triton.jit
def spin_of(numbers, roll, x, y, z):
    return tl.where(along_shaft(numbers, x, y, z) < tl.load(numbers + SPIN_END), roll, 0.0)


@triton.jit
def articulate(
    numbers, logits, roll, g, inside, x, y, z, qw, qx, qy, qz,
    SPINS: tl.constexpr, JOINTS: tl.constexpr, LINKS: tl.constexpr, SLIDES: tl.constexpr, LOGITS: tl.constexpr,
):  # fmt: skip
    """Resting means and quaternions moved by roll and joints, and the terms of the shares of links: the gate, the
    greatest logit, the sum of exponentials, the share that moves; 0 without joints."""
    gate, greatest, total, moving = 0.0 * x, 0.0 * x, 0.0 * x, 0.0 * x
    if JOINTS > 0:
        gate = gate_of(numbers, x, y, z)
        greatest, total = softmax_of(logits, g, inside, LINKS, LOGITS)
        moving = moving_of(logits, g, inside, greatest, total, gate, LINKS, LOGITS)
    if SPINS:
        x, y, z, qw, qx, qy, qz = turn(
            numbers + SHAFT_ORIGIN, numbers + SHAFT_DIRECTION, spin_of(numbers, roll, x, y, z), x, y, z, qw, qx, qy, qz
        )
    for joint in tl.static_range(JOINTS):
        own_numbers = numbers + BODY + joint * (VALUES + LINKS - 1)
        amount = amount_of(logits, own_numbers, g, inside, greatest, total, gate, LINKS, LOGITS)
        if (SLIDES >> joint) & 1:
            x, y, z = slide(own_numbers + 3, amount, x, y, z)
        else:
            x, y, z, qw, qx, qy, qz = turn(own_numbers, own_numbers + 3, amount, x, y, z, qw, qx, qy, qz)
    return x, y, z, qw, qx, qy, qz, gate, greatest, total, moving


@triton.jit(do_not_specialize=["roll", "start", "count"])
def pose_kernel(
    means, quats, log_scales, logits, numbers, roll, to_means, to_quats, to_scales, to_frames, start, count,
    SPINS: tl.constexpr, JOINTS: tl.constexpr, LINKS: tl.constexpr, SLIDES: tl.constexpr, LOGITS: tl.constexpr,
    BLOCK: tl.constexpr,
):  # fmt: skip
    """Pose one body; numbers None: it is fixed."""
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
        x, y, z, qw, qx, qy, qz, _, _, _, moving = articulate(
            numbers, logits, roll, g, inside, x, y, z, qw, qx, qy, qz, SPINS, JOINTS, LINKS, SLIDES, LOGITS
        )
        if JOINTS > 0:
            longest = tl.load(numbers + LONGEST) / tl.maximum(moving, 1e-6)
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
def turn_backward(
    pivot, axis, angle, sums_pivot, sums_axis, inside, x, y, z, qw, qx, qy, qz, gx, gy, gz, hw, hx, hy, hz
):
    """Return points and quaternions, and their gradients g and h, before the rotation, and dL/d angle; sums of dL/d
    pivot and dL/d axis are written."""
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
    put_sums(sums_pivot, gx - mx, gy - my, gz - mz, inside)
    return x, y, z, qw, qx, qy, qz, mx, my, mz, hw, hx, hy, hz, to_angle


@triton.jit(do_not_specialize=["roll", "start", "count"])
def pose_backward_kernel(
    means, quats, log_scales, logits, numbers, roll, from_means, from_quats, from_scales,
    to_means, to_quats, to_log_scales, to_logits, sums, start, count,
    SPINS: tl.constexpr, JOINTS: tl.constexpr, LINKS: tl.constexpr, SLIDES: tl.constexpr, LOGITS: tl.constexpr,
    BLOCK: tl.constexpr,
):  # fmt: skip
    """sums [programs, 22 + J (5 + L)]: of dL/d numbers; dL/d the pose's quaternion stands where none is wanted."""
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
        block = sums + tl.program_id(0) * (BODY + JOINTS * (VALUES + LINKS - 1))
        x, y, z, qw, qx, qy, qz, norm = resting(means, quats, g, inside)
        rw, rx, ry, rz = qw, qx, qy, qz
        spin = spin_of(numbers, roll, x, y, z)
        x, y, z, qw, qx, qy, qz, gate, greatest, total, moving = articulate(
            numbers, logits, roll, g, inside, x, y, z, qw, qx, qy, qz, SPINS, JOINTS, LINKS, SLIDES, LOGITS
        )
        if JOINTS > 0:
            longest = tl.load(numbers + LONGEST) / tl.maximum(moving, 1e-6)
            wx = tl.where(sx < longest, wx, 0.0)
            wy = tl.where(sy < longest, wy, 0.0)
            wz = tl.where(sz < longest, wz, 0.0)
        put_pose_row(block, gx, x, y, z, inside)
        put_pose_row(block + 4, gy, x, y, z, inside)
        put_pose_row(block + 8, gz, x, y, z, inside)
        gx, gy, gz = (
            tl.load(numbers) * gx + tl.load(numbers + 4) * gy + tl.load(numbers + 8) * gz,
            tl.load(numbers + 1) * gx + tl.load(numbers + 5) * gy + tl.load(numbers + 9) * gz,
            tl.load(numbers + 2) * gx + tl.load(numbers + 6) * gy + tl.load(numbers + 10) * gz,
        )
        tw, tx, ty, tz = product(hw, hx, hy, hz, qw, 0.0 - qx, 0.0 - qy, 0.0 - qz)
        put_sum(block + SPIN_END, tw, inside)
        put_sums(block + SPIN_END + 1, tx, ty, tz, inside)
        _, a, b, c, d, length = pose_row(numbers)
        hw, hx, hy, hz = product(a / length, 0.0 - b / length, 0.0 - c / length, 0.0 - d / length, hw, hx, hy, hz)
        shared = 0.0 * gx  # sum over links of share times dL/d share
        for undone in tl.static_range(JOINTS):
            joint = JOINTS - 1 - undone
            own_numbers = numbers + BODY + joint * (VALUES + LINKS - 1)
            to_numbers = block + BODY + joint * (VALUES + LINKS - 1)
            amount = amount_of(logits, own_numbers, g, inside, greatest, total, gate, LINKS, LOGITS)
            if (SLIDES >> joint) & 1:
                x, y, z = slide(own_numbers + 3, 0.0 - amount, x, y, z)
                nx, ny, nz = three(own_numbers + 3)
                to_amount = nx * gx + ny * gy + nz * gz
                put_sums(to_numbers + 3, amount * gx, amount * gy, amount * gz, inside)
            else:
                x, y, z, qw, qx, qy, qz, gx, gy, gz, hw, hx, hy, hz, to_amount = turn_backward(
                    own_numbers, own_numbers + 3, amount, to_numbers, to_numbers + 3, inside, x, y, z, qw, qx, qy, qz,
                    gx, gy, gz, hw, hx, hy, hz,
                )  # fmt: skip
            shared += to_amount * amount
            for link in tl.static_range(1, LINKS):
                share = share_of(logits, link, g, inside, greatest, total, LOGITS) * gate
                put_sum(to_numbers + VALUES + link - 1, to_amount * share, inside)
                at = to_logits + g * LOGITS + link  # zero before the first joint
                to_share = to_amount * tl.load(own_numbers + VALUES + link - 1) * gate
                tl.store(at, tl.load(at, inside, other=0.0) + to_share, inside)
            tl.debug_barrier()  # stores must be visible to later loads
        if JOINTS > 0:
            for link in tl.static_range(LINKS):
                at = to_logits + g * LOGITS + link
                share = share_of(logits, link, g, inside, greatest, total, LOGITS)
                tl.store(at, share * (tl.load(at, inside, other=0.0) - shared), inside)
        if SPINS:
            x, y, z, qw, qx, qy, qz, gx, gy, gz, hw, hx, hy, hz, _ = turn_backward(
                numbers + SHAFT_ORIGIN, numbers + SHAFT_DIRECTION, spin, block + SHAFT_ORIGIN, block + SHAFT_DIRECTION,
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
    put_sums(at, gradient * x, gradient * y, gradient * z, inside)
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
    """Row, column and sign with which a gradient of an entry of Shepperd's matrix goes in the pose (rows of four)."""
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


BLOCK = 128  # Gaussians per program


class Posing:
    """Bodies that follow each other in the rows, `counts` long; where a body's numbers are None it stands still. `how`:
    of each how many links it has, which joints slide (bits) and by how much it rolls. All tensors are float32,
    contiguous and on one device."""

    def __init__(
        self,
        means: Tensor,
        quats: Tensor,
        log_scales: Tensor,
        logits: Tensor | None,
        counts: Sequence[int],
        numbers: Sequence[Tensor | None],
        how: Sequence[tuple[int, int, float]],
    ) -> None:
        self.given = (means, quats, log_scales, logits)
        self.columns = 0 if logits is None else logits.shape[1]
        starts = [sum(counts[:body]) for body in range(len(counts))]
        self.bodies = list(zip(starts, counts, numbers, how, strict=True))

    def forward(self, means: Tensor, quats: Tensor, scales: Tensor, frames: Tensor) -> None:
        """Write the posed Gaussians."""
        with working_on(means.device):
            for start, count, numbers, how in self.bodies:
                if count:
                    pose_kernel[(triton.cdiv(count, BLOCK),)](
                        *self.given, numbers, how[2], means, quats, scales, frames, start, count,
                        **self._how(numbers, *how),
                    )  # fmt: skip

    def backward(
        self,
        means: Tensor,
        quats: Tensor,
        scales: Tensor,
        to_means: Tensor,
        to_quats: Tensor,
        to_log_scales: Tensor,
        to_logits: Tensor | None,
        to_numbers: Sequence[Tensor | None],
    ) -> None:
        """Write gradients of the inputs, which must be zero-initialised, from those of means, quats and scales."""
        with working_on(means.device):
            for (start, count, numbers, how), to in zip(self.bodies, to_numbers, strict=True):
                if not count:
                    continue
                programs = triton.cdiv(count, BLOCK)
                sums = None if numbers is None else torch.zeros(programs, len(numbers), device=means.device)
                pose_backward_kernel[(programs,)](
                    *self.given, numbers, how[2], means, quats, scales, to_means, to_quats, to_log_scales, to_logits,
                    sums, start, count, **self._how(numbers, *how),
                )  # fmt: skip
                if numbers is not None:
                    width = len(numbers)
                    pose_sums_kernel[(1,)](
                        sums,
                        numbers,
                        to,
                        programs,
                        WIDTH=width,
                        PADDED=triton.next_power_of_2(width),
                        num_warps=1,
                        enable_fp_fusion=True,
                    )

    def _how(self, numbers: Tensor | None, links: int, slides: int, roll: float) -> dict[str, int | bool]:
        joints = 0 if numbers is None else (len(numbers) - BODY.value) // (VALUES.value + links - 1)
        return {
            "SPINS": numbers is not None and roll != 0,
            "JOINTS": joints,
            "LINKS": links,
            "SLIDES": slides,
            "LOGITS": self.columns,
            "BLOCK": BLOCK,
            "num_warps": 4,
            "enable_fp_fusion": True,
        }
