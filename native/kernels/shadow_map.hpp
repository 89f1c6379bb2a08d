// A map of what casts, as a lamp sees it, and what stands behind that: neeco/raster/shadow.py defines both.
#pragma once

#include "simd.hpp"

namespace neeco {
namespace NEECO_VARIANT {

constexpr float kFaint = 1e-4f, kNearZero = 1e-6f;

// An image read between its pixels' middles, 0 outside, and how that changes across and down.
struct Reading {
    float value, across, down;
};

NEECO_INLINE Reading look_up(const float* image, int width, int height, float x, float y) {
    x -= 0.5f, y -= 0.5f;
    if (!(x > -1 && y > -1 && x < width && y < height)) return {0, 0, 0};
    const int column = (int)__builtin_floorf(x), row = (int)__builtin_floorf(y);
    const float u = x - column, v = y - row;
    auto at = [&](int r, int c) { return r < 0 || c < 0 || r >= height || c >= width ? 0.f : image[(size_t)r * width + c]; };
    const float a = at(row, column), b = at(row, column + 1), c = at(row + 1, column), d = at(row + 1, column + 1);
    return {(1 - v) * ((1 - u) * a + u * b) + v * ((1 - u) * c + u * d), (1 - v) * (b - a) + v * (d - c), (1 - u) * (c - a) + u * (d - b)};
}

// How opaque the casters are before a point of depth z at pixel (x, y) of the map, and how deep they are there.
struct Blocked {
    Reading share;
    float before;
    bool hit;
};

NEECO_INLINE Blocked blocked_at(const float* alpha, const float* weighted, int width, int height, float x, float y, float z) {
    const Reading share = look_up(alpha, width, height, x, y);
    if (!(share.value > kFaint)) return {share, 0, false};
    const float before = higher(look_up(weighted, width, height, x, y).value / higher(share.value, kNearZero), kNearZero);
    return {share, before, z > before};
}

}  // namespace NEECO_VARIANT
}  // namespace neeco
