// Shared by the projection and its gradient: W Gaussians at a time, from world to image.
#pragma once

#include "simd.hpp"
#include "kernels.hpp"

namespace neeco {
namespace NEECO_VARIANT {

// Everything about W projected Gaussians. Covariance in the image = U U^T + low-pass, U = T R S, T = J camera_from_world.
struct Projected {
    vf wx, wy, wz;            // mean, world
    vf x, y, z, inverse_z;    // mean, camera
    vf slope_x, slope_y;      // x/z and y/z where the projection is linearised
    vi clamped_x, clamped_y;
    vf q[4], inverse_norm;    // unit quaternion
    vf r[9];                  // its matrix
    vf s[3];                  // scales
    vf t[6], u[6];
    vf cov_xx, cov_xy, cov_yy, det;
    vi usable;                // finite and in front of the camera
};

NEECO_INLINE void rotation_matrix(const vf* q, vf* r) {
    const vf w = q[0], x = q[1], y = q[2], z = q[3];
    r[0] = 1.f - 2.f * (y * y + z * z);
    r[1] = 2.f * (x * y - w * z);
    r[2] = 2.f * (x * z + w * y);
    r[3] = 2.f * (x * y + w * z);
    r[4] = 1.f - 2.f * (x * x + z * z);
    r[5] = 2.f * (y * z - w * x);
    r[6] = 2.f * (x * z - w * y);
    r[7] = 2.f * (y * z + w * x);
    r[8] = 1.f - 2.f * (x * x + y * y);
}

// Depth: in double, rounded once, so that every backend and instruction set sorts the same numbers.
NEECO_INLINE vf depth_lanes(const Camera& c, const Projected& p) {
    typedef double d4 __attribute__((vector_size(32)));
    float x[W], y[W], z[W], depth[W];
    store(x, p.wx);
    store(y, p.wy);
    store(z, p.wz);
    for (int i = 0; i < W; i += 4) {
        const d4 dx = __builtin_convertvector(quad(x + i), d4), dy = __builtin_convertvector(quad(y + i), d4),
                 dz = __builtin_convertvector(quad(z + i), d4);
        const d4 sum = ((c.depth_row[0] * dx + c.depth_row[1] * dy) + c.depth_row[2] * dz) + c.depth_row[3];
        *(v4_loose*)(depth + i) = (v4_loose)__builtin_convertvector(sum, v4);
    }
    return load(depth);
}

// Rows of three floats. Loads take four: at the array's very end, one by one.
NEECO_INLINE void load_triples(const float* base, int count, const int* index, vf* out) {
    bool at_end = false;
    for (int i = 0; i < W; i++) at_end |= index[i] == count - 1;
    if (at_end) {
        for (int k = 0; k < 3; k++) out[k] = gather(base + k, index, 3);
        return;
    }
    vf quads[4];
    load_quads(base, 3, index, quads);
    for (int k = 0; k < 3; k++) out[k] = quads[k];
}

NEECO_INLINE Projected project_lanes(const Camera& c, const GaussianInputs& in, const int* index) {
    Projected p;
    vf mean[3];
    load_triples(in.means, in.count, index, mean);
    p.wx = mean[0];
    p.wy = mean[1];
    p.wz = mean[2];
    p.z = depth_lanes(c, p);
    p.x = c.rotation[0] * p.wx + c.rotation[1] * p.wy + c.rotation[2] * p.wz + c.translation[0];
    p.y = c.rotation[3] * p.wx + c.rotation[4] * p.wy + c.rotation[5] * p.wz + c.translation[1];
    p.inverse_z = 1.f / p.z;
    const vf slope_x = p.x * p.inverse_z, slope_y = p.y * p.inverse_z;
    p.slope_x = lower(higher(slope_x, all(c.low_x)), all(c.high_x));
    p.slope_y = lower(higher(slope_y, all(c.low_y)), all(c.high_y));
    p.clamped_x = p.slope_x != slope_x;
    p.clamped_y = p.slope_y != slope_y;

    const vf jx = c.fx * p.inverse_z, jy = c.fy * p.inverse_z;
    for (int k = 0; k < 3; k++) {
        p.t[k] = jx * (c.rotation[k] - p.slope_x * c.rotation[6 + k]);
        p.t[3 + k] = jy * (c.rotation[3 + k] - p.slope_y * c.rotation[6 + k]);
    }
    vf norm2 = all(0.f);
    load_quads(in.quats, 4, index, p.q);
    for (int k = 0; k < 4; k++) norm2 += p.q[k] * p.q[k];
    p.inverse_norm = 1.f / root(norm2);
    for (int k = 0; k < 4; k++) p.q[k] *= p.inverse_norm;
    rotation_matrix(p.q, p.r);
    load_triples(in.scales, in.count, index, p.s);
    for (int k = 0; k < 3; k++) {
        p.u[k] = (p.t[0] * p.r[k] + p.t[1] * p.r[3 + k] + p.t[2] * p.r[6 + k]) * p.s[k];
        p.u[3 + k] = (p.t[3] * p.r[k] + p.t[4] * p.r[3 + k] + p.t[5] * p.r[6 + k]) * p.s[k];
    }
    const vf xx = p.u[0] * p.u[0] + p.u[1] * p.u[1] + p.u[2] * p.u[2];
    const vf yy = p.u[3] * p.u[3] + p.u[4] * p.u[4] + p.u[5] * p.u[5];
    p.cov_xx = xx + kLowPass;
    p.cov_xy = p.u[0] * p.u[3] + p.u[1] * p.u[4] + p.u[2] * p.u[5];
    p.cov_yy = yy + kLowPass;
    // det(U U^T) is the sum of the squared minors of U: no cancellation for needles.
    const vf a = p.u[0] * p.u[4] - p.u[1] * p.u[3], b = p.u[0] * p.u[5] - p.u[2] * p.u[3], d = p.u[1] * p.u[5] - p.u[2] * p.u[4];
    p.det = a * a + b * b + d * d + kLowPass * (xx + yy) + kLowPass * kLowPass;
    p.usable = finite(p.x) & finite(p.y) & finite(p.z) & finite(p.wx) & finite(p.wy) & finite(p.wz) & finite(norm2) &
               finite(p.det) & finite(p.cov_xx) & finite(p.cov_yy) & finite(1.f / p.det) & finite(p.inverse_norm) &
               finite(p.s[0]) & finite(p.s[1]) & finite(p.s[2]) & finite(p.inverse_z) & (p.z > c.nearest);
    return p;
}

// The headlight's factor and what its gradient needs.
struct Light {
    vf factor, distance2, log2_distance, t;
};

NEECO_INLINE Light light_lanes(const GaussianInputs& in, const Projected& p, const int* index) {
    Light light;
    light.distance2 = p.x * p.x + p.y * p.y + p.z * p.z;
    light.log2_distance = 0.5f * log2_fast(light.distance2 * 1e-4f);  // of distance / 100 mm
    light.t = p.slope_x * p.slope_x + p.slope_y * p.slope_y;  // clamped: beyond the field its powers would blind the image
    const vf vignette = in.vignette[0] * light.t + in.vignette[1] * light.t * light.t;
    const vf exponent = kLog2E * vignette - gather(in.falloff, index, 1) * light.log2_distance;
    const vi ok = finite(exponent);  // a NaN falloff must stay NaN
    light.factor = select(ok, exp2_fast(lower(higher(exponent, all(-125.f)), all(125.f))), exponent);
    return light;
}

// Unit direction from the camera centre, in the Gaussian's SH frame; `world` gets it in the world frame.
struct Direction {
    vf world[3], local[3], frame[9], inverse_length;
};

NEECO_INLINE Direction direction_lanes(const Camera& c, const GaussianInputs& in, const Projected& p, const int* index) {
    Direction d;
    const vf dx = p.wx - c.centre[0], dy = p.wy - c.centre[1], dz = p.wz - c.centre[2];
    d.inverse_length = 1.f / root(dx * dx + dy * dy + dz * dz);
    d.world[0] = dx * d.inverse_length;
    d.world[1] = dy * d.inverse_length;
    d.world[2] = dz * d.inverse_length;
    if (in.sh_frames) {
        vf q[4];
        load_quads(in.sh_frames, 4, index, q);
        rotation_matrix(q, d.frame);
        for (int k = 0; k < 3; k++)
            d.local[k] = d.frame[k] * d.world[0] + d.frame[3 + k] * d.world[1] + d.frame[6 + k] * d.world[2];
    } else {
        for (int k = 0; k < 3; k++) d.local[k] = d.world[k];
    }
    return d;
}

}  // namespace NEECO_VARIANT
}  // namespace neeco
