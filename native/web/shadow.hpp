// The shadows of what moves on what stands still, as neeco/raster/shadow.py draws them: the same definition, forward only.
#pragma once

#include <algorithm>
#include <cmath>
#include <vector>

#include "kernels.hpp"
#include "shadow_map.hpp"

namespace neeco {

constexpr float kResolution = 0.5f, kMargin = 0.15f;  // of the image's, and of its size to each side
constexpr int kTaps = 6;
constexpr float kGamma = 2.2f, kDarkest = 0.01f;

struct Lamp {
    float offset[3];  // mm, in the camera's frame
    float strength;   // share of the light
};

// A map [height, width] as the lamp sees the casters, and how much of its light they keep from everything behind them.
class ShadowMap {
public:
    // Of casters that were drawn from the lamp: alpha and expected depth [height, width]; blurred by `sigma` px.
    void blur(const float* alpha, const float* depth, int width, int height, float sigma) {
        width_ = width, height_ = height;
        const std::vector<float> across = weights(width, sigma), down = weights(height, sigma);
        const size_t size = (size_t)width * height;
        std::vector<float> weighted(size);
        for (size_t i = 0; i < size; i++) weighted[i] = alpha[i] * depth[i];
        blurred(alpha, across, down, alpha_);
        blurred(weighted.data(), across, down, weighted_);
    }

    // Share of the light that misses a point of depth z (from the lamp) at pixel (x, y) of the map.
    float blocked(float x, float y, float z) const {
        const Blocked found = blocked_at(alpha_.data(), weighted_.data(), width_, height_, x, y, z);
        return found.hit ? found.share.value : 0;
    }

private:
    static std::vector<float> weights(int size, float sigma) {
        std::vector<float> taps(2 * kTaps + 1);
        float total = 0;
        for (int k = -kTaps; k <= kTaps; k++) {
            const float step = (float)k / std::max(sigma, 0.3f);
            taps[k + kTaps] = std::exp(-0.5f * step * step);
            if (size / 2 + k >= 0 && size / 2 + k < size) total += taps[k + kTaps];
        }
        for (float& tap : taps) tap /= total;
        return taps;
    }

    void blurred(const float* image, const std::vector<float>& across, const std::vector<float>& down, std::vector<float>& out) const {
        std::vector<float> rows((size_t)width_ * height_);
        out.assign(rows.size(), 0.f);
        for (int y = 0; y < height_; y++)
            for (int k = -kTaps; k <= kTaps; k++) {
                const int from = std::max(0, -k), to = std::min(width_, width_ - k);
                float* row = rows.data() + (size_t)y * width_;
                const float *source = image + (size_t)y * width_ + k, tap = across[k + kTaps];
                for (int x = from; x < to; x++) row[x] += tap * source[x];
            }
        for (int y = 0; y < height_; y++)
            for (int k = std::max(-kTaps, -y); k <= std::min(kTaps, height_ - 1 - y); k++) {
                float* row = out.data() + (size_t)y * width_;
                const float *source = rows.data() + (size_t)(y + k) * width_, tap = down[k + kTaps];
                for (int x = 0; x < width_; x++) row[x] += tap * source[x];
            }
    }

    int width_ = 0, height_ = 0;
    std::vector<float> alpha_, weighted_;
};

}  // namespace neeco
