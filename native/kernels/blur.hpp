// A plane under a separable window, zero outside, and how that changes with one number that the window depends on.
#pragma once

#include "frame.hpp"
#include "parallel.hpp"
#include "simd.hpp"

namespace neeco {
namespace NEECO_VARIANT {

constexpr int kBlurRows = 16;  // per task

struct BlurInputs {
    int height, width, reach;
    const float* image;                      // [H, W]
    const float *down, *across;              // [2 reach + 1] windows
    const float *down_slope, *across_slope;  // and their derivatives, where the plane's is wanted
};

NEECO_INLINE size_t blur_stride(int width) { return ((size_t)width + W - 1) / W * W; }

// Sum over the window of what lies `step` floats apart.
NEECO_INLINE vf under_window(const float* first, size_t step, const float* window, int size) {
    vf sum = all(0.f);
    for (int k = 0; k < size; k++) sum += window[k] * load(first + step * k);
    return sum;
}

NEECO_INLINE int blur_tasks(int height) { return (height + kBlurRows - 1) / kBlurRows; }

// Floats that `blur` works in.
NEECO_INLINE size_t blur_room(int height, int width, int reach) {
    const size_t stride = blur_stride(width);
    return 2 * stride * (height + 2 * reach) + blur_tasks(height) * (stride + 2 * reach);
}

// out [H, W]; slope: that of `out` where the windows' slopes are those, or null.
static void blur(const BlurInputs& in, float* room, float* out, float* slope) {
    const int size = 2 * in.reach + 1, tasks = blur_tasks(in.height);
    const size_t stride = blur_stride(in.width), plane = stride * (in.height + 2 * in.reach);
    float* rows = room;  // blurred along rows; the same for the slope
    float *rows_slope = rows + plane, *padded = rows_slope + plane;
    for (float* p : {rows, rows_slope}) {
        std::memset(p, 0, in.reach * stride * 4);
        std::memset(p + plane - in.reach * stride, 0, in.reach * stride * 4);
    }
    auto along = [&](int task) {
        float* row = padded + task * (stride + 2 * in.reach);
        std::memset(row, 0, (stride + 2 * in.reach) * 4);
        for (int y = task * kBlurRows; y < lower((task + 1) * kBlurRows, in.height); y++) {
            std::memcpy(row + in.reach, in.image + (size_t)y * in.width, (size_t)in.width * 4);
            const size_t to = (y + in.reach) * stride;
            for (size_t i = 0; i < stride; i += W) {
                store(rows + to + i, under_window(row + i, 1, in.across, size));
                if (slope) store(rows_slope + to + i, under_window(row + i, 1, in.across_slope, size));
            }
        }
    };
    parallel_for(tasks, along);
    auto down = [&](int task) {
        for (int y = task * kBlurRows; y < lower((task + 1) * kBlurRows, in.height); y++)
            for (int i = 0; i < in.width; i += W) {
                const size_t from = y * stride + i, to = (size_t)y * in.width + i, bytes = 4 * (size_t)lower(W, in.width - i);
                const vf value = under_window(rows + from, stride, in.down, size);
                std::memcpy(out + to, &value, bytes);
                if (!slope) continue;
                const vf change = under_window(rows + from, stride, in.down_slope, size) + under_window(rows_slope + from, stride, in.down, size);
                std::memcpy(slope + to, &change, bytes);
            }
    };
    parallel_for(tasks, down);
}

}  // namespace NEECO_VARIANT
}  // namespace neeco
