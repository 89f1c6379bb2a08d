// Harmonics of Gaussians that miss some of their light, and the gradient: neeco/raster/shadow.py defines both.
#pragma once

#include "kernels.hpp"
#include "parallel.hpp"
#include "simd.hpp"

namespace neeco {
namespace NEECO_VARIANT {

constexpr int kDimRows = 1024;  // per task

// By what stored colours are multiplied where this share of the light is missed: what is left, to the power of 1 / gamma.
NEECO_INLINE vf lit_by(const DimInputs& in, vf missing) {
    return exp2_fast(log2_fast(higher(1.f - missing, all(in.darkest))) * (1 / in.gamma));
}

// body(row, factor) for every Gaussian; factors are worked out a vector at a time.
template <class F>
NEECO_INLINE void each_dimmed(const DimInputs& in, F&& body) {
    auto task = [&](int number) {
        const int end = lower((number + 1) * kDimRows, in.count);
        for (int first = number * kDimRows; first < end; first += W) {
            const int rows = lower(W, end - first);
            float missing[W] = {}, factor[W];
            std::memcpy(missing, in.missing + first, 4 * rows);
            store(factor, lit_by(in, load(missing)));
            for (int i = 0; i < rows; i++) body(first + i, factor[i]);
        }
    };
    parallel_for((in.count + kDimRows - 1) / kDimRows, task);
}

static void dim(const DimInputs& in, float* out) {
    each_dimmed(in, [&](int n, float factor) {
        const float* from = in.sh + (size_t)n * in.width;
        float* to = out + (size_t)n * in.width;
        for (int i = 0; i < in.width; i++) to[i] = from[i] * factor;
        for (int c = 0; c < 3; c++) to[c] += in.half * (factor - 1.f);
    });
}

static void dim_backward(const DimInputs& in, const float* from, float* to_sh, float* to_missing) {
    each_dimmed(in, [&](int n, float factor) {
        const float *gradient = from + (size_t)n * in.width, *own = in.sh + (size_t)n * in.width;
        float* to = to_sh + (size_t)n * in.width;
        vf lanes = all(0.f);
        int i = 0;
        for (; i + W <= in.width; i += W) {
            const vf g = load(gradient + i);
            lanes += g * load(own + i);
            store(to + i, g * factor);
        }
        float total = sum(lanes) + in.half * (gradient[0] + gradient[1] + gradient[2]);
        for (; i < in.width; i++) {
            total += gradient[i] * own[i];
            to[i] = gradient[i] * factor;
        }
        const float left = 1.f - in.missing[n];
        to_missing[n] = left > in.darkest ? -total * factor / (in.gamma * left) : 0.f;
    });
}

}  // namespace NEECO_VARIANT
}  // namespace neeco
