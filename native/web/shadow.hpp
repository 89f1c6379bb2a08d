// The shadows of what moves on what stands still, as neeco/raster/shadow.py draws them: the same definition, forward only.
#pragma once

#include <algorithm>
#include <cmath>

#include "kernels.hpp"
#include "kernels/blur.hpp"
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
        float across[2 * kTaps + 1], down[2 * kTaps + 1];
        set_window(across, width, sigma);
        set_window(down, height, sigma);
        const size_t size = (size_t)width * height;
        float* product = product_.reserve(size);
        for (size_t i = 0; i < size; i++) product[i] = alpha[i] * depth[i];
        const BlurInputs in = {height, width, kTaps, alpha, down, across, nullptr, nullptr};
        wasm::blur(in, work_, alpha_.reserve(size), nullptr);
        BlurInputs of_product = in;
        of_product.image = product;
        wasm::blur(of_product, work_, weighted_.reserve(size), nullptr);
    }

    // Share of the light that misses a point of depth z (from the lamp) at pixel (x, y) of the map.
    float blocked(float x, float y, float z) const {
        const Blocked found = blocked_at(alpha_.data(), weighted_.data(), width_, height_, x, y, z);
        return found.hit ? found.share.value : 0;
    }

private:
    static void set_window(float* taps, int size, float sigma) {
        float total = 0;
        for (int k = -kTaps; k <= kTaps; k++) {
            const float step = (float)k / std::max(sigma, 0.3f);
            taps[k + kTaps] = std::exp(-0.5f * step * step);
            if (size / 2 + k >= 0 && size / 2 + k < size) total += taps[k + kTaps];
        }
        for (int k = 0; k <= 2 * kTaps; k++) taps[k] /= total;
    }

    int width_ = 0, height_ = 0;
    Buffer<float> alpha_, weighted_, product_, work_;
};

}  // namespace neeco
