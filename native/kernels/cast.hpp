// How much of a lamp's light Gaussians miss behind what casts, from a map of that as the lamp sees it, and the gradient:
// neeco/raster/shadow.py defines both.
#pragma once

#include <cmath>

#include "blur.hpp"
#include "shadow_map.hpp"

namespace neeco {
namespace NEECO_VARIANT {

constexpr int kCastRows = 1024;  // per task
constexpr int kTaps = 6;         // pixels to each side of the middle of the window that blurs
constexpr float kNarrowest = 0.3f;  // px

// The window of a line of `size` pixels, which sums to 1 about the line's middle, and its derivative by sigma.
static void set_window(float* window, float* slope, int size, float sigma) {
    double weight[2 * kTaps + 1], growth[2 * kTaps + 1], total = 0, grown = 0;
    const double wide = higher(sigma, kNarrowest);
    for (int k = -kTaps; k <= kTaps; k++) {
        const int i = k + kTaps;
        weight[i] = std::exp(-0.5 * (k / wide) * (k / wide));
        growth[i] = sigma >= kNarrowest ? weight[i] * k * k / (wide * wide * wide) : 0;
        if (size / 2 + k < 0 || size / 2 + k >= size) continue;
        total += weight[i];
        grown += growth[i];
    }
    for (int i = 0; i <= 2 * kTaps; i++) {
        window[i] = (float)(weight[i] / total);
        slope[i] = (float)((growth[i] - weight[i] * grown / total) / total);
    }
}

// The part [top, top + height) x [left, left + width) of a map in which anything casts, once it is blurred. Nothing is drawn beyond.
static CastMaps crop_to_casters(const CastInputs& in, float* maps) {
    int left = in.width, right = -1, top = in.height, bottom = -1;
    for (int y = 0; y < in.height; y++) {
        const float* row = in.alpha + (size_t)y * in.width;
        int first = 0, last = in.width - 1;
        while (first < in.width && row[first] == 0) first++;
        if (first == in.width) continue;
        while (row[last] == 0) last--;
        left = lower(left, first), right = higher(right, last);
        top = lower(top, y), bottom = y;
    }
    CastMaps m;
    m.left = higher(left - kTaps, 0), m.top = higher(top - kTaps, 0);
    m.width = higher(lower(right + kTaps + 1, in.width) - m.left, 0);
    m.height = higher(lower(bottom + kTaps + 1, in.height) - m.top, 0);
    const size_t size = (size_t)m.width * m.height;
    m.opacity = maps, m.weighted = maps + size, m.slope = maps + 2 * size;
    return m;
}

// Blurs what casts: its opacity, that times depth, and the opacity's derivative by sigma where `slope`.
static CastMaps blur_casters(const CastInputs& in, Buffer<float>& work, float* maps, bool slope) {
    const CastMaps m = crop_to_casters(in, maps);
    if (m.width == 0 || m.height == 0) return m;
    float across[2 * kTaps + 1], down[2 * kTaps + 1], across_slope[2 * kTaps + 1], down_slope[2 * kTaps + 1];
    set_window(across, across_slope, in.width, in.sigma);
    set_window(down, down_slope, in.height, in.sigma);
    const size_t size = (size_t)m.width * m.height;
    float *alpha = work.reserve(2 * size + blur_room(m.height, m.width, kTaps)), *product = alpha + size, *room = product + size;
    for (int y = 0; y < m.height; y++)
        for (int x = 0; x < m.width; x++) {
            const size_t from = (size_t)(m.top + y) * in.width + m.left + x, to = (size_t)y * m.width + x;
            alpha[to] = in.alpha[from];
            product[to] = in.alpha[from] * in.depth[from];
        }
    BlurInputs blurred = {m.height, m.width, kTaps, alpha, down, across, down_slope, across_slope};
    blur(blurred, room, m.opacity, slope ? m.slope : nullptr);
    blurred.image = product;
    blur(blurred, room, m.weighted, nullptr);
    return m;
}

NEECO_INLINE Blocked blocked_in(const CastMaps& m, float column, float row, float z) {
    return blocked_at(m.opacity, m.weighted, m.width, m.height, column - m.left, row - m.top, z);
}

// Where points are as the lamp's camera sees them.
template <class F>
struct Seen {
    F x, y, z, deep, column, row;
};
template <class F>
NEECO_INLINE Seen<F> seen_by_lamp(const CastInputs& in, F wx, F wy, F wz) {
    const float* r = in.rotation;
    const F dx = wx - in.centre[0], dy = wy - in.centre[1], dz = wz - in.centre[2];
    Seen<F> s;
    s.x = r[0] * dx + r[1] * dy + r[2] * dz - in.offset[0];
    s.y = r[3] * dx + r[4] * dy + r[5] * dz - in.offset[1];
    s.z = r[6] * dx + r[7] * dy + r[8] * dz - in.offset[2];
    s.deep = higher(s.z, F{} + in.nearest);
    s.column = s.x / s.deep * in.fx + in.cx;
    s.row = s.y / s.deep * in.fy + in.cy;
    return s;
}
NEECO_INLINE Seen<float> seen_by_lamp(const CastInputs& in, int n) {
    return seen_by_lamp<float>(in, in.means[3 * n], in.means[3 * n + 1], in.means[3 * n + 2]);
}

// shares [N]: of the lamp's light that each Gaussian misses, 0 for what casts.
static CastMaps cast(const CastInputs& in, Buffer<float>& work, float* maps, bool slope, float* shares) {
    const CastMaps m = blur_casters(in, work, maps, slope);
    const float left = m.left - 0.5f, right = m.left + m.width + 0.5f, top = m.top - 0.5f, bottom = m.top + m.height + 0.5f;
    auto task = [&](int number) {
        const int end = lower((number + 1) * kCastRows, in.count);
        for (int first = number * kCastRows; first < end; first += W) {
            int index[W];
            for (int i = 0; i < W; i++) index[i] = lower(first + i, end - 1);
            const Seen<vf> s = seen_by_lamp<vf>(in, gather(in.means, index, 3), gather(in.means + 1, index, 3), gather(in.means + 2, index, 3));
            const vi near = (s.column > left) & (s.column < right) & (s.row > top) & (s.row < bottom);
            for (int i = 0; i < lower(W, end - first); i++) shares[first + i] = 0;
            if (!any(near)) continue;
            for (int i = 0; i < lower(W, end - first); i++) {
                if (!near[i] || (in.casters && in.casters[first + i])) continue;
                const Blocked found = blocked_in(m, s.column[i], s.row[i], s.z[i]);
                if (found.hit) shares[first + i] = found.share.value;
            }
        }
    };
    parallel_for((in.count + kCastRows - 1) / kCastRows, task);
    return m;
}

// to [4]: dL/d offset and dL/d sigma, of gradients [N] of the shares that `cast` found, with the maps it left.
static void cast_backward(const CastInputs& in, const CastMaps& m, const float* shares, const float* gradient, Buffer<double>& partial,
                          float* to) {
    const int tasks = (in.count + kCastRows - 1) / kCastRows;
    double* sums = partial.reserve(4 * tasks);
    auto task = [&](int number) {
        double* sum = sums + 4 * number;
        sum[0] = sum[1] = sum[2] = sum[3] = 0;
        for (int n = number * kCastRows; n < lower((number + 1) * kCastRows, in.count); n++) {
            if (shares[n] == 0) continue;
            const Seen<float> s = seen_by_lamp(in, n);
            const Blocked found = blocked_in(m, s.column, s.row, s.z);
            // the point moves across the map as the lamp does, and to first order so does the map of what casts
            const float across = gradient[n] * found.share.across, down = gradient[n] * found.share.down;
            const float by_depth = s.z > in.nearest ? 1 / (s.deep * s.deep) : 0.f;
            sum[0] += across * in.fx * (1 / found.before - 1 / s.deep);
            sum[1] += down * in.fy * (1 / found.before - 1 / s.deep);
            sum[2] += across * (in.fx * s.x * by_depth - (s.column - in.cx) / found.before) +
                      down * (in.fy * s.y * by_depth - (s.row - in.cy) / found.before);
            sum[3] += gradient[n] * look_up(m.slope, m.width, m.height, s.column - m.left, s.row - m.top).value;
        }
    };
    parallel_for(tasks, task);
    double total[4] = {};
    for (int k = 0; k < 4 * tasks; k++) total[k % 4] += sums[k];
    for (int k = 0; k < 4; k++) to[k] = (float)total[k];
}

}  // namespace NEECO_VARIANT
}  // namespace neeco
