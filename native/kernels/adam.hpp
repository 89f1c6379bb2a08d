// Adam (Kingma and Ba 2015), one pass over parameter, gradient and both moments.
#pragma once

#include "kernels.hpp"
#include "parallel.hpp"
#include "simd.hpp"

namespace neeco {
namespace NEECO_VARIANT {

NEECO_INLINE void adam_range(const AdamStep& s, size_t from, size_t to) {
    for (size_t i = from; i < to; i++) {
        const float g = s.gradient[i];
        const float mean = s.mean[i] + (1.f - s.beta1) * (g - s.mean[i]);
        const float square = s.beta2 * s.square[i] + (1.f - s.beta2) * g * g;
        s.mean[i] = mean;
        s.square[i] = square;
        s.parameter[i] -= s.lr / s.correction1 * mean / (__builtin_sqrtf(square) / s.correction2_root + s.eps);
    }
}

static void adam(const AdamStep& s) {
    // Vectors and a scalar tail round alike (IEEE division and root), so chunk borders do not show in the result.
    constexpr size_t grain = 1 << 15;
    auto body = [&](int number) {
        const size_t from = (size_t)number * grain, to = from + grain < s.count ? from + grain : s.count;
        adam_range(s, from, to);
    };
    parallel_for((int)((s.count + grain - 1) / grain), body);
}

}  // namespace NEECO_VARIANT
}  // namespace neeco
