// Harmonics whose colour, half a unit more than they say, is multiplied by a factor of each Gaussian's own, and the gradient.
#pragma once

#include "kernels.hpp"
#include "parallel.hpp"
#include "simd.hpp"

namespace neeco {
namespace NEECO_VARIANT {

constexpr int kBrightenRows = 1024;  // per task

template <class F>
NEECO_INLINE void each_rows(int count, F&& body) {
    auto task = [&](int number) {
        for (int n = number * kBrightenRows; n < lower((number + 1) * kBrightenRows, count); n++) body(n);
    };
    parallel_for((count + kBrightenRows - 1) / kBrightenRows, task);
}

static void brighten(int count, int width, float half, const float* sh, const float* factors, float* out) {
    each_rows(count, [&](int n) {
        const float* from = sh + (size_t)n * width;
        float* to = out + (size_t)n * width;
        const float factor = factors[n];
        for (int i = 0; i < width; i++) to[i] = from[i] * factor;
        for (int c = 0; c < 3; c++) to[c] += half * (factor - 1.f);
    });
}

static void brighten_backward(int count, int width, float half, const float* sh, const float* factors, const float* from, float* to_sh,
                              float* to_factors) {
    each_rows(count, [&](int n) {
        const float *gradient = from + (size_t)n * width, *own = sh + (size_t)n * width;
        float* to = to_sh + (size_t)n * width;
        const float factor = factors[n];
        vf lanes = all(0.f);
        int i = 0;
        for (; i + W <= width; i += W) {
            const vf g = load(gradient + i);
            lanes += g * load(own + i);
            store(to + i, g * factor);
        }
        float total = sum(lanes) + half * (gradient[0] + gradient[1] + gradient[2]);
        for (; i < width; i++) {
            total += gradient[i] * own[i];
            to[i] = gradient[i] * factor;
        }
        to_factors[n] = total;
    });
}

}  // namespace NEECO_VARIANT
}  // namespace neeco
