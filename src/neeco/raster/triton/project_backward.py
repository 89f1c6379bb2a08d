"""Stage 5: gradients of the Gaussians and of the camera from those of the projected Gaussians."""

import torch
import triton
import triton.language as tl
from torch import Tensor

from neeco.geometry.camera import Camera
from neeco.raster.triton.composite import HEAD
from neeco.raster.triton.geometry import (
    LOG2_E,
    covariance,
    direction,
    headlight,
    projected,
    put_sums,
    quadruple,
    quadruple_at,
    sh_gradient,
    triple_at,
    view_rotation,
)
from neeco.raster.triton.project import RECORD, Inputs, Projected, turned

BLOCK = 128
CAMERA_SUMS = tl.constexpr(18)  # camera_from_world (rotation 9, translation 3), centre 3, vignette 2, nothing


@triton.jit
def shape_gradient(
    to_xx, to_xy, to_yy, t0, t1, t2, t3, t4, t5, u0, u1, u2, u3, u4, u5, r0, r1, r2, r3, r4, r5, r6, r7, r8, sx, sy, sz
):
    """Return, through U = T R S, dL/d T (6), dL/d scales (3), dL/d R (9)."""
    a0, a1, a2 = 2 * (to_xx * u0 + to_xy * u3), 2 * (to_xx * u1 + to_xy * u4), 2 * (to_xx * u2 + to_xy * u5)
    b0, b1, b2 = 2 * (to_xy * u0 + to_yy * u3), 2 * (to_xy * u1 + to_yy * u4), 2 * (to_xy * u2 + to_yy * u5)
    w0, w3, w6 = a0 * t0 + b0 * t3, a0 * t1 + b0 * t4, a0 * t2 + b0 * t5
    w1, w4, w7 = a1 * t0 + b1 * t3, a1 * t1 + b1 * t4, a1 * t2 + b1 * t5
    w2, w5, w8 = a2 * t0 + b2 * t3, a2 * t1 + b2 * t4, a2 * t2 + b2 * t5
    a0, a1, a2, b0, b1, b2 = a0 * sx, a1 * sy, a2 * sz, b0 * sx, b1 * sy, b2 * sz
    return (
        a0 * r0 + a1 * r1 + a2 * r2, a0 * r3 + a1 * r4 + a2 * r5, a0 * r6 + a1 * r7 + a2 * r8,
        b0 * r0 + b1 * r1 + b2 * r2, b0 * r3 + b1 * r4 + b2 * r5, b0 * r6 + b1 * r7 + b2 * r8,
        w0 * r0 + w3 * r3 + w6 * r6, w1 * r1 + w4 * r4 + w7 * r7, w2 * r2 + w5 * r5 + w8 * r8,
        w0 * sx, w1 * sy, w2 * sz, w3 * sx, w4 * sy, w5 * sz, w6 * sx, w7 * sy, w8 * sz,
    )  # fmt: skip


@triton.jit
def quaternion_gradient(w, x, y, z, inverse_norm, v0, v1, v2, v3, v4, v5, v6, v7, v8):
    """Return dL/d quaternion, whose direction is (w, x, y, z), from dL/d R."""
    gw = 2 * (x * (v7 - v5) + y * (v2 - v6) + z * (v3 - v1))
    gx = 2 * (y * (v1 + v3) + z * (v2 + v6) + w * (v7 - v5) - 2 * x * (v4 + v8))
    gy = 2 * (x * (v1 + v3) + z * (v5 + v7) + w * (v2 - v6) - 2 * y * (v0 + v8))
    gz = 2 * (x * (v2 + v6) + y * (v5 + v7) + w * (v3 - v1) - 2 * z * (v0 + v4))
    along = gw * w + gx * x + gy * y + gz * z
    return (
        (gw - along * w) * inverse_norm,
        (gx - along * x) * inverse_norm,
        (gy - along * y) * inverse_norm,
        (gz - along * z) * inverse_norm,
    )


@triton.jit
def put(at, value, inside, seen):
    """Store `value`, 0 where not visible."""
    tl.store(at, tl.where(seen, value, 0.0), inside)


@triton.jit
def put_three(at, a, b, c, inside, seen):
    """Store three consecutive numbers."""
    put(at, a, inside, seen)
    put(at + 1, b, inside, seen)
    put(at + 2, c, inside, seen)


@triton.jit
def ellipse_gradient(h1, h2, h3, h4, h5, xx, xy, yy, determinant):
    """Return gradients of projected centre (2) and covariance (xx, xy, yy) from sums over pixels of h d and h d d^T."""
    a, b, c = yy / determinant, 0.0 - xy / determinant, xx / determinant  # inverse covariance Q
    # d alpha / d covariance = 1/2 alpha Q d d^T Q
    m00, m01, m11 = 0.5 * h3, 0.5 * h4, 0.5 * h5
    q00, q01, q10, q11 = a * m00 + b * m01, a * m01 + b * m11, b * m00 + c * m01, b * m01 + c * m11
    # with d = pixel - centre: d alpha / d centre = alpha Q d
    return a * h1 + b * h2, b * h1 + c * h2, q00 * a + q01 * b, q00 * b + q01 * c, q10 * b + q11 * c


@triton.jit
def mean_gradient(
    pose, to_x, to_y, to_z, g0, g1, g2, g3, g4, g5, x, y, iz, slope_x, slope_y, clamped_x, clamped_y, fx, fy
):
    """Return the gradient of the mean, camera frame, through projected centre, depth and T (g0 to g5)."""
    c0, c1, c2, c3, c4, c5, c6, c7, c8 = view_rotation(pose)
    jx, jy = fx * iz, fy * iz
    to_jxx, to_jxz = g0 * c0 + g1 * c1 + g2 * c2, g0 * c6 + g1 * c7 + g2 * c8
    to_jyy, to_jyz = g3 * c3 + g4 * c4 + g5 * c5, g3 * c6 + g4 * c7 + g5 * c8
    # jxz = -fx slope_x / z with slope_x = x / z, or a constant where it is clamped
    x_free, y_free = tl.where(clamped_x, 0.0, to_jxz), tl.where(clamped_y, 0.0, to_jyz)
    mx = jx * to_x - jx * iz * x_free
    my = jy * to_y - jy * iz * y_free
    mz = to_z - iz * (jx * (x * to_x + to_jxx) + jy * (y * to_y + to_jyy))
    mz += iz * (jx * slope_x * (to_jxz + x_free) + jy * slope_y * (to_jyz + y_free))
    return mx, my, mz


@triton.jit
def light_gradient(
    falloff, vignette, to_falloff, g, inside, seen, to_log, x, y, z, iz, slope_x, slope_y, clamped_x, clamped_y
):
    """Store the falloff's gradient from that of the light's logarithm; return the mean's (3), the factor and t."""
    power = tl.load(falloff + g, seen, other=0.0)
    light, log2_distance, t = headlight(power, vignette, x, y, z, slope_x, slope_y)
    put(to_falloff + g, 0.0 - to_log * log2_distance / LOG2_E, inside, seen)
    by_distance = 0.0 - power * to_log / (x * x + y * y + z * z)
    by_t = to_log * (tl.load(vignette) + 2 * tl.load(vignette + 1) * t) * 2 * iz
    free_x, free_y = tl.where(clamped_x, 0.0, slope_x), tl.where(clamped_y, 0.0, slope_y)
    mx, my = by_distance * x + by_t * free_x, by_distance * y + by_t * free_y
    return mx, my, by_distance * z - by_t * (free_x * free_x + free_y * free_y), light, t


@triton.jit
def direction_gradient(
    sh, to_sh, frames, pose, g, inside, seen, wx, wy, wz, red, green, blue, to_red, to_green, to_blue, SH: tl.constexpr
):
    """Store the harmonics' gradients through max(0, sh . basis + 0.5); return the mean's (3) by its direction."""
    to_red, to_green = tl.where(red > 0, to_red, 0.0), tl.where(green > 0, to_green, 0.0)
    to_blue = tl.where(blue > 0, to_blue, 0.0)
    dx, dy, dz, inverse_length = direction(pose, wx, wy, wz)
    lx, ly, lz = dx, dy, dz
    if frames is not None:
        f0, f1, f2, f3 = quadruple(frames, g, seen)
        lx, ly, lz = turned(f0, f1, f2, f3, dx, dy, dz)
    lx, ly, lz = sh_gradient(
        sh + g * (3 * SH), to_sh if to_sh is None else to_sh + g * (3 * SH), inside, seen, lx, ly, lz,
        to_red, to_green, to_blue, SH, to_sh is not None,
    )  # fmt: skip
    if frames is not None:
        lx, ly, lz = turned(f0, 0.0 - f1, 0.0 - f2, 0.0 - f3, lx, ly, lz)
    along = lx * dx + ly * dy + lz * dz
    return (lx - along * dx) * inverse_length, (ly - along * dy) * inverse_length, (lz - along * dz) * inverse_length


@triton.jit(do_not_specialize=["count"])
def project_backward_kernel(
    means, quats, scales, opacities, sh, falloff, left, vignette, pose, frames, records, counts, sums,
    to_centers, to_means, to_quats, to_scales, to_opacities, to_sh, to_falloff, to_left, camera_sums,
    count, fx, fy, cx, cy, width, height, near,
    SH: tl.constexpr, WIDTH: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """One Gaussian per lane. sums [N, WIDTH]; camera_sums [programs, 18], None: not wanted."""
    g = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    inside = g < count
    seen = tl.load(counts + g, inside, other=0) > 0
    (
        wx, wy, wz, x, y, z, iz, slope_x, slope_y, clamped_x, clamped_y, t0, t1, t2, t3, t4, t5,
        qw, qx, qy, qz, inorm, r0, r1, r2, r3, r4, r5, r6, r7, r8, sx, sy, sz, u0, u1, u2, u3, u4, u5,
    ) = projected(means, quats, scales, pose, g, seen, fx, fy, cx, cy, width, height, near)  # fmt: skip
    xx, xy, yy, determinant = covariance(u0, u1, u2, u3, u4, u5)
    h0, h1, h2, h3 = quadruple_at(sums + g * WIDTH, seen)
    h4, h5, to_red, to_green = quadruple_at(sums + g * WIDTH + 4, seen)
    to_blue, to_z = tl.load(sums + g * WIDTH + 8, seen, other=0.0), tl.load(sums + g * WIDTH + 9, seen, other=0.0)
    to_x, to_y, to_xx, to_xy, to_yy = ellipse_gradient(h1, h2, h3, h4, h5, xx, xy, yy, determinant)
    g0, g1, g2, g3, g4, g5, to_sx, to_sy, to_sz, v0, v1, v2, v3, v4, v5, v6, v7, v8 = shape_gradient(
        to_xx, to_xy, to_yy, t0, t1, t2, t3, t4, t5, u0, u1, u2, u3, u4, u5,
        r0, r1, r2, r3, r4, r5, r6, r7, r8, sx, sy, sz,
    )  # fmt: skip
    to_qw, to_qx, to_qy, to_qz = quaternion_gradient(qw, qx, qy, qz, inorm, v0, v1, v2, v3, v4, v5, v6, v7, v8)
    put(to_opacities + g, h0 / tl.load(opacities + g, seen, other=1.0), inside, seen)
    put(to_centers + g * 2, to_x, inside, seen)
    put(to_centers + g * 2 + 1, to_y, inside, seen)
    put_three(to_scales + g * 3, to_sx, to_sy, to_sz, inside, seen)
    put(to_quats + g * 4, to_qw, inside, seen)
    put_three(to_quats + g * 4 + 1, to_qx, to_qy, to_qz, inside, seen)

    mx, my, mz = mean_gradient(
        pose, to_x, to_y, to_z, g0, g1, g2, g3, g4, g5, x, y, iz, slope_x, slope_y, clamped_x, clamped_y, fx, fy
    )
    red, green, blue = triple_at(records + g * RECORD + 6, seen)
    to_log = to_red * red + to_green * green + to_blue * blue  # of whatever multiplies colours
    if left is not None:
        dimmed = tl.load(left + g, seen, other=1.0)
        put(to_left + g, to_log / dimmed, inside, seen)
        to_red, to_green, to_blue = to_red * dimmed, to_green * dimmed, to_blue * dimmed
    if falloff is not None:
        lx, ly, lz, light, t = light_gradient(
            falloff, vignette, to_falloff, g, inside, seen, to_log, x, y, z, iz, slope_x, slope_y, clamped_x, clamped_y
        )
        mx, my, mz = mx + lx, my + ly, mz + lz
        to_red, to_green, to_blue = to_red * light, to_green * light, to_blue * light
        if camera_sums is not None:
            put_sums(camera_sums + tl.program_id(0) * CAMERA_SUMS + 15, to_log * t, to_log * t * t, 0.0 * t, seen)
    dx, dy, dz = direction_gradient(
        sh, to_sh, frames, pose, g, inside, seen, wx, wy, wz, red, green, blue, to_red, to_green, to_blue, SH
    )
    c0, c1, c2, c3, c4, c5, c6, c7, c8 = view_rotation(pose)
    put_three(
        to_means + g * 3, c0 * mx + c3 * my + c6 * mz + dx, c1 * mx + c4 * my + c7 * mz + dy,
        c2 * mx + c5 * my + c8 * mz + dz, inside, seen,
    )  # fmt: skip
    if camera_sums is not None:
        to = camera_sums + tl.program_id(0) * CAMERA_SUMS
        jx, jy = fx * iz, fy * iz
        ox, oy = jx * slope_x, jy * slope_y
        put_sums(to, jx * g0 + mx * wx, jx * g1 + mx * wy, jx * g2 + mx * wz, seen)
        put_sums(to + 3, jy * g3 + my * wx, jy * g4 + my * wy, jy * g5 + my * wz, seen)
        put_sums(to + 6, mz * wx - ox * g0 - oy * g3, mz * wy - ox * g1 - oy * g4, mz * wz - ox * g2 - oy * g5, seen)
        put_sums(to + 9, mx, my, mz, seen)
        put_sums(to + 12, 0.0 - dx, 0.0 - dy, 0.0 - dz, seen)


def project_backward(
    inputs: Inputs, projected: Projected, camera: Camera, sums: Tensor, want_sh: bool, want_camera: bool
) -> tuple[Tensor, list[Tensor | None]]:
    """Return gradients of the projected centres [N, 2], and of the inputs in their order but for background and frames,
    from the Gaussians' `sums` [N, 10 + C]; of pose and vignette if `want_camera`."""
    n, device = len(inputs), inputs.means.device
    programs = triton.cdiv(n, BLOCK)
    partial = torch.zeros(programs, CAMERA_SUMS.value, device=device) if want_camera else None
    to_sh = torch.empty_like(inputs.sh) if want_sh else None
    to_falloff = None if inputs.falloff is None else torch.empty_like(inputs.falloff)
    to_left = None if inputs.left is None else torch.empty_like(inputs.left)
    to = [torch.empty_like(t) for t in (inputs.means, inputs.quats, inputs.scales, inputs.opacities)]
    centers = torch.empty(n, 2, device=device)
    if n:
        project_backward_kernel[(programs,)](
            inputs.means, inputs.quats, inputs.scales, inputs.opacities, inputs.sh, inputs.falloff, inputs.left,
            inputs.vignette, inputs.pose, inputs.frames, projected.records, projected.counts, sums,
            centers, *to, to_sh, to_falloff, to_left, partial,
            n, camera.fx, camera.fy, camera.cx, camera.cy, float(camera.width), float(camera.height), camera.near,
            SH=inputs.sh.shape[1], WIDTH=sums.stride(0), BLOCK=BLOCK, num_warps=4, enable_fp_fusion=True,
        )  # fmt: skip
    pose, vignette = None, None
    if partial is not None:
        total = partial.double().sum(0)
        pose, vignette = _pose_gradient(total, inputs.pose.double()), total[15:17].float()
    channels = None if inputs.channels is None else sums[:, HEAD.value :]
    return centers, [*to, to_sh, to_falloff, channels, to_left, vignette, pose]


def _pose_gradient(total: Tensor, pose: Tensor) -> Tensor:
    """world_from_camera = [R | c], camera_from_world = [R^T | -R^T c]: from the second's gradient to the first's."""
    rotation, translation, centre = total[:9].reshape(3, 3), total[9:12], total[12:15]
    gradient = torch.zeros_like(pose)
    gradient[:3, :3] = rotation.T - torch.outer(pose[:3, 3], translation)
    gradient[:3, 3] = centre - pose[:3, :3] @ translation
    return gradient.float()
