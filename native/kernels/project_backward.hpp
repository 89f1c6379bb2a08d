// Stage 6: from gradients of the projected Gaussians to gradients of the Gaussians and of the camera.
#pragma once

#include "geometry.hpp"
#include "parallel.hpp"
#include "sh.hpp"

namespace neeco {
namespace NEECO_VARIANT {

// Sums over Gaussians that belong to the camera: camera_from_world (rotation 9, translation 3), centre 3, vignette 2.
constexpr int kCameraSums = 17;

NEECO_INLINE void scatter(float* base, const int* index, int stride, int live, vf v) {
    for (int i = 0; i < live; i++) base[(size_t)stride * index[i]] = v[i];
}

// Gradients with respect to the camera-frame mean, gathered from several sources.
struct MeanGradient {
    vf camera[3], world[3];
};

// Through U = T R S: writes scales and rotation gradients, returns dL/dT in to_t.
NEECO_INLINE void shape_gradient(const Projected& p, vf to_xx, vf to_xy, vf to_yy, vf* to_t, vf* to_scale, vf* to_quat) {
    vf to_u[6], v[9];
    for (int k = 0; k < 3; k++) {
        to_u[k] = 2.f * (to_xx * p.u[k] + to_xy * p.u[3 + k]);
        to_u[3 + k] = 2.f * (to_xy * p.u[k] + to_yy * p.u[3 + k]);
    }
    for (int k = 0; k < 3; k++) {
        to_scale[k] = all(0.f);
        for (int j = 0; j < 3; j++) {
            const vf w = to_u[k] * p.t[j] + to_u[3 + k] * p.t[3 + j];
            to_scale[k] += w * p.r[3 * j + k];
            v[3 * j + k] = w * p.s[k];
        }
    }
    for (int row = 0; row < 2; row++)
        for (int j = 0; j < 3; j++)
            to_t[3 * row + j] = to_u[3 * row] * p.s[0] * p.r[3 * j] + to_u[3 * row + 1] * p.s[1] * p.r[3 * j + 1] +
                                to_u[3 * row + 2] * p.s[2] * p.r[3 * j + 2];
    const vf w = p.q[0], x = p.q[1], y = p.q[2], z = p.q[3];
    const vf g[4] = {2.f * (x * (v[7] - v[5]) + y * (v[2] - v[6]) + z * (v[3] - v[1])),
                     2.f * (y * (v[1] + v[3]) + z * (v[2] + v[6]) + w * (v[7] - v[5]) - 2.f * x * (v[4] + v[8])),
                     2.f * (x * (v[1] + v[3]) + z * (v[5] + v[7]) + w * (v[2] - v[6]) - 2.f * y * (v[0] + v[8])),
                     2.f * (x * (v[2] + v[6]) + y * (v[5] + v[7]) + w * (v[3] - v[1]) - 2.f * z * (v[0] + v[4]))};
    const vf along = g[0] * w + g[1] * x + g[2] * y + g[3] * z;
    for (int k = 0; k < 4; k++) to_quat[k] = (g[k] - along * p.q[k]) * p.inverse_norm;
}

// Through T = J camera_from_world and the projected centre: adds to the camera-frame mean and to the rotation sums.
NEECO_INLINE void projection_gradient(const Camera& c, const Projected& p, const vf* to_t, vf to_x, vf to_y, MeanGradient& m, vf* sums) {
    const vf iz = p.inverse_z, iz2 = iz * iz, jx = c.fx * iz, jy = c.fy * iz;
    vf to_jxx = all(0.f), to_jxz = all(0.f), to_jyy = all(0.f), to_jyz = all(0.f);
    for (int k = 0; k < 3; k++) {
        to_jxx += to_t[k] * c.rotation[k];
        to_jxz += to_t[k] * c.rotation[6 + k];
        to_jyy += to_t[3 + k] * c.rotation[3 + k];
        to_jyz += to_t[3 + k] * c.rotation[6 + k];
        sums[k] += jx * to_t[k];
        sums[3 + k] += jy * to_t[3 + k];
        sums[6 + k] -= jx * p.slope_x * to_t[k] + jy * p.slope_y * to_t[3 + k];
    }
    // jxz = -fx slope_x / z with slope_x = x / z, or a constant where it is clamped
    const vf x_free = select(p.clamped_x, all(0.f), to_jxz), y_free = select(p.clamped_y, all(0.f), to_jyz);
    m.camera[0] += jx * to_x - c.fx * iz2 * x_free;
    m.camera[1] += jy * to_y - c.fy * iz2 * y_free;
    m.camera[2] += -iz2 * (c.fx * p.x * to_x + c.fy * p.y * to_y) - c.fx * iz2 * to_jxx - c.fy * iz2 * to_jyy +
                   c.fx * iz2 * p.slope_x * (to_jxz + x_free) + c.fy * iz2 * p.slope_y * (to_jyz + y_free);
}

// Through colour = max(0, sh . basis + 0.5) * light * gain: SH, falloff, gain, and the mean.
NEECO_INLINE void color_gradient(const Frame& frame, const GaussianInputs& in, const GaussianGradients& to, const Projected& p,
                                 const int* index, int live, const vf* to_color, const vf* drawn, MeanGradient& m, vf* sums) {
    const Camera& c = frame.camera;
    vf factor = in.gains ? gather(in.gains, index, 1) : all(1.f);
    const vf to_log = to_color[0] * drawn[0] + to_color[1] * drawn[1] + to_color[2] * drawn[2];  // of what multiplies colours
    if (to.gains) scatter(to.gains, index, 1, live, to_log / factor);
    if (in.falloff) {
        const Light light = light_lanes(in, p, index);
        factor *= light.factor;
        const vf falloff = gather(in.falloff, index, 1);
        if (to.falloff) scatter(to.falloff, index, 1, live, to_log * light.log2_distance * -kLn2);
        const vf by_distance = -falloff * to_log / light.distance2;
        const vf by_t = to_log * (in.vignette[0] + 2.f * in.vignette[1] * light.t) * 2.f * p.inverse_z;
        const vf free_x = select(p.clamped_x, all(0.f), p.slope_x), free_y = select(p.clamped_y, all(0.f), p.slope_y);
        m.camera[0] += by_distance * p.x + by_t * free_x;
        m.camera[1] += by_distance * p.y + by_t * free_y;
        m.camera[2] += by_distance * p.z - by_t * (free_x * free_x + free_y * free_y);
        sums[15] += to_log * light.t;
        sums[16] += to_log * light.t * light.t;
    }
    vf to_base[3];
    for (int ch = 0; ch < 3; ch++) to_base[ch] = select(drawn[ch] > 0.f, to_color[ch] * factor, all(0.f));
    const int count = in.sh_count;
    vf basis[16], w[16];
    basis[0] = all(kSh0);
    Direction d;
    if (count > 1) {
        d = direction_lanes(c, in, p, index);
        sh_basis(count, d.local, basis);
    }
    if (to.sh)
        for (int i = 0; i < live; i++) {
            float* out = to.sh + (size_t)index[i] * count * 3;
            for (int k = 0; k < count; k++)
                for (int ch = 0; ch < 3; ch++) out[3 * k + ch] = basis[k][i] * to_base[ch][i];
        }
    if (count == 1) return;
    sh_products(count, in.sh, index, to_base, w);
    vf local[3], world[3];
    sh_direction_gradient(count, d.local, w, local);
    for (int k = 0; k < 3; k++)
        world[k] = in.sh_frames ? d.frame[3 * k] * local[0] + d.frame[3 * k + 1] * local[1] + d.frame[3 * k + 2] * local[2] : local[k];
    const vf along = world[0] * d.world[0] + world[1] * d.world[1] + world[2] * d.world[2];
    for (int k = 0; k < 3; k++) {
        const vf g = (world[k] - along * d.world[k]) * d.inverse_length;
        m.world[k] += g;
        sums[12 + k] -= g;
    }
}

// One batch of drawn Gaussians; lanes beyond `live` repeat the first and are silenced.
NEECO_INLINE void backward_batch(Frame& frame, const GaussianInputs& in, const GaussianGradients& to, const int* index, int live, vf* sums) {
    const Camera& c = frame.camera;
    const int stride = frame.slot_stride();
    alignas(64) float slot_sums[W][48] = {};
    for (int i = 0; i < live; i++) {
        const Span span = frame.spans.data()[index[i]];
        const float* slot = frame.slots.data() + ((size_t)frame.chunks[index[i] >> kChunkBits].base + span.first) * stride;
        for (uint32_t n = 0; n < span.count; n++, slot += stride)
            for (int k = 0; k < stride; k += 8) *(v8_loose*)(slot_sums[i] + k) += *(const v8_loose*)(slot + k);
    }
    vf h[kRecordHead + 4], drawn[3];
    for (int k = 0; k < kRecordHead + 4; k++)
        for (int i = 0; i < W; i++) h[k][i] = slot_sums[i][k];
    for (int k = 0; k < 3; k++) drawn[k] = gather(frame.records.data() + kRecordHead + k, index, frame.record_stride);
    if (to.channels)
        for (int i = 0; i < live; i++)
            for (int ch = 0; ch < in.channel_count; ch++)
                to.channels[(size_t)index[i] * in.channel_count + ch] = slot_sums[i][kRecordHead + 4 + ch];

    const Projected p = project_lanes(c, in, index);
    const vf inverse_det = 1.f / p.det;
    const vf a = p.cov_yy * inverse_det, b = -p.cov_xy * inverse_det, cc = p.cov_xx * inverse_det;  // inverse covariance Q
    // with d = pixel - centre: d alpha / d centre = alpha Q d
    const vf to_x = a * h[1] + b * h[2], to_y = b * h[1] + cc * h[2];
    // d alpha / d covariance = 1/2 alpha Q d d^T Q
    const vf m00 = 0.5f * h[3], m01 = 0.5f * h[4], m11 = 0.5f * h[5];
    const vf q00 = a * m00 + b * m01, q01 = a * m01 + b * m11, q10 = b * m00 + cc * m01, q11 = b * m01 + cc * m11;
    const vf to_xx = q00 * a + q01 * b, to_xy = q00 * b + q01 * cc, to_yy = q10 * b + q11 * cc;

    vf to_t[6], to_scale[3], to_quat[4];
    shape_gradient(p, to_xx, to_xy, to_yy, to_t, to_scale, to_quat);
    MeanGradient m = {{all(0.f), all(0.f), h[kRecordHead + 3]}, {all(0.f), all(0.f), all(0.f)}};
    projection_gradient(c, p, to_t, to_x, to_y, m, sums);
    color_gradient(frame, in, to, p, index, live, h + kRecordHead, drawn, m, sums);
    const vf mean[3] = {p.wx, p.wy, p.wz};
    for (int k = 0; k < 3; k++) {
        for (int j = 0; j < 3; j++) {
            m.world[k] += c.rotation[3 * j + k] * m.camera[j];
            sums[3 * k + j] += m.camera[k] * mean[j];
        }
        sums[9 + k] += m.camera[k];
    }
    if (to.opacities) scatter(to.opacities, index, 1, live, h[0] / gather(in.opacities, index, 1));
    for (int k = 0; k < 3 && to.means; k++) scatter(to.means + k, index, 3, live, m.world[k]);
    for (int k = 0; k < 3 && to.scales; k++) scatter(to.scales + k, index, 3, live, to_scale[k]);
    for (int k = 0; k < 4 && to.quats; k++) scatter(to.quats + k, index, 4, live, to_quat[k]);
    if (to.centers) {
        scatter(to.centers, index, 2, live, to_x);
        scatter(to.centers + 1, index, 2, live, to_y);
    }
}

NEECO_INLINE void clear_row(float* base, size_t row, size_t length) {
    if (base) std::memset(base + row * length, 0, length * 4);
}

static void clear_gradients(const GaussianInputs& in, const GaussianGradients& to, size_t g) {
    clear_row(to.means, g, 3);
    clear_row(to.quats, g, 4);
    clear_row(to.scales, g, 3);
    clear_row(to.opacities, g, 1);
    clear_row(to.sh, g, (size_t)in.sh_count * 3);
    clear_row(to.falloff, g, 1);
    clear_row(to.channels, g, (size_t)in.channel_count);
    clear_row(to.gains, g, 1);
    clear_row(to.centers, g, 2);
}

// world_from_camera = [R | c] and camera_from_world = [R^T | -R^T c]: from gradients of the second to those of the first.
static void camera_gradient(const Camera& c, const double* sums, float* out) {
    for (int i = 0; i < 16; i++) out[i] = 0;
    for (int i = 0; i < 3; i++)  // row of camera_from_world = column of R
        for (int j = 0; j < 3; j++) out[4 * j + i] = (float)(sums[3 * i + j] - sums[9 + i] * c.centre[j]);
    for (int j = 0; j < 3; j++) {
        double g = sums[12 + j];
        for (int i = 0; i < 3; i++) g -= c.rotation[3 * i + j] * sums[9 + i];
        out[4 * j + 3] = (float)g;
    }
}

static void project_backward(Frame& frame, const GaussianInputs& in, const GaussianGradients& to) {
    const int chunks = (in.count + kChunk - 1) / kChunk;
    double* partial = frame.partial.reserve((size_t)chunks * kCameraSums);
    auto body = [&](int number) {
        vf sums[kCameraSums];
        for (int k = 0; k < kCameraSums; k++) sums[k] = all(0.f);
        double* total = partial + (size_t)number * kCameraSums;
        for (int k = 0; k < kCameraSums; k++) total[k] = 0;
        int index[W], live = 0;
        const int end = lower(in.count, (number + 1) << kChunkBits);
        for (int g = number << kChunkBits; g < end; g++) {
            if (frame.spans.data()[g].count == 0) clear_gradients(in, to, g);
            else index[live++] = g;
            if (live == W || (g == end - 1 && live > 0)) {
                for (int i = live; i < W; i++) index[i] = index[0];
                backward_batch(frame, in, to, index, live, sums);
                for (int k = 0; k < kCameraSums; k++) {
                    total[k] += sum(sums[k]);
                    sums[k] = all(0.f);
                }
                live = 0;
            }
        }
    };
    parallel_for(chunks, body);
    double total[kCameraSums] = {};
    for (int n = 0; n < chunks; n++)
        for (int k = 0; k < kCameraSums; k++) total[k] += partial[(size_t)n * kCameraSums + k];
    if (to.world_from_camera) camera_gradient(frame.camera, total, to.world_from_camera);
    if (to.vignette)
        for (int k = 0; k < 2; k++) to.vignette[k] = (float)total[15 + k];
}

}  // namespace NEECO_VARIANT
}  // namespace neeco
