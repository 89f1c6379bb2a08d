// Stage 5: the gradient of blending, back to front. Every (tile, Gaussian) pair has a slot of its own: no atomics.
//
// Slot: sums over pixels of h, h dx, h dy, h dx^2, h dx dy, h dy^2 with h = alpha dL/dalpha (0 where alpha is clamped),
// then dL/d value for each composited value.
#pragma once

#include "composite.hpp"

namespace neeco {
namespace NEECO_VARIANT {

template <int V>
struct TileGradients {
    alignas(64) float transmittance[kTilePixels];
    alignas(64) float behind[kTilePixels];  // sum over what lies behind of weight * (gradient . value), minus dL/dalpha * T
    alignas(64) float depth[kTilePixels];   // as drawn
    alignas(64) float wanted[kTileHeight / kRows][V][W];
    alignas(64) int32_t last[kTilePixels];
};

// Loads the image gradients of one tile; returns the highest position in the list at which any pixel stopped.
template <int V>
static int load_tile(const Frame& frame, const Tile& tile, const ImageGradients& from, int channels, TileGradients<V>& s) {
    std::memset(s.wanted, 0, sizeof s.wanted);
    std::memset(s.behind, 0, sizeof s.behind);
    std::memset(s.depth, 0, sizeof s.depth);
    for (int i = 0; i < kTilePixels; i++) {
        s.transmittance[i] = 1.f;
        s.last[i] = -1;
    }
    int highest = -1;
    for (int y = 0; y < tile.height; y++)
        for (int x = 0; x < tile.width; x++) {
            const size_t pixel = (size_t)(tile.y + y) * frame.camera.width + tile.x + x;
            const int i = y * kStrip + x, lane = y % kRows * kStrip + x;
            float(*wanted)[W] = s.wanted[y / kRows];
            const float to_alpha = from.alpha ? from.alpha[pixel] : 0.f;
            // depth = sum of weight * z / alpha, so d depth / d weight = (z - depth) / alpha
            s.depth[i] = from.drawn_depth[pixel];
            if (from.depth && from.drawn_alpha[pixel] > 0) wanted[3][lane] = from.depth[pixel] / from.drawn_alpha[pixel];
            float behind = -to_alpha;
            if (from.color)
                for (int c = 0; c < 3; c++) {
                    const float v = from.color[3 * pixel + c];
                    wanted[c][lane] = v;
                    if (from.background) behind += from.background[c] * v;
                }
            if (from.channels)
                for (int c = 0; c < channels; c++) wanted[4 + c][lane] = from.channels[pixel * channels + c];
            const float left = frame.transmittance.data()[pixel];
            s.transmittance[i] = left;
            s.behind[i] = behind * left;
            s.last[i] = frame.last.data()[pixel];
            highest = higher(highest, s.last[i]);
        }
    return highest;
}

template <int V>
NEECO_INLINE void backward_pair(const float* record, const Pair& pair, int k, const Tile& tile, TileGradients<V>& s, float* slot) {
    constexpr int stride = (kRecordHead + V + 7) / 8 * 8;
    const Record& g = *(const Record*)record;
    vf value[V], to_value[V];
    for (int c = 0; c < V; c++) {
        value[c] = all(record[kRecordHead + c]);
        to_value[c] = all(0.f);
    }
    const int from = pair.first_row / kRows, to = (pair.end_row + kRows - 1) / kRows;
    const vf dx = lane_x() + ((float)tile.x + 0.5f - g.x);
    const vf constant = g.a * dx * dx + g.log2_opacity, linear = g.b * dx;
    vf dy = lane_y() + ((float)(from * kRows + tile.y) + 0.5f - g.y);
    vf sum_h = all(0.f), sum_hy = all(0.f), sum_hyy = all(0.f);
    for (int row = from; row < to; row++, dy += (float)kRows) {
        const vf exponent = (g.c * dy + linear) * dy + constant;
        const vf raw = exp2_fast(exponent);
        const vi drawn = (exponent >= kLog2Faintest) & (*(const vi*)(s.last + row * W) > k);
        vf alpha = raw < kOpaque ? raw : all(kOpaque);
        alpha = select(drawn, alpha, all(0.f));
        const vf free_alpha = select(drawn & (raw <= kOpaque), raw, all(0.f));
        vf* transmittance = (vf*)(s.transmittance + row * W);
        vf* behind = (vf*)(s.behind + row * W);
        const vf scale = 1.f / (1.f - alpha);
        const vf before = *transmittance * scale;
        *transmittance = before;
        const vf weight = alpha * before;
        const vf* wanted = (const vf*)s.wanted[row];
        vf agreement = all(0.f);
        for (int c = 0; c < V; c++) {
            const vf w = wanted[c];
            // z and depth nearly cancel: subtract them before anything is rounded
            agreement += (c == 3 ? value[c] - *(const vf*)(s.depth + row * W) : value[c]) * w;
            to_value[c] += weight * w;
        }
        const vf to_alpha = before * agreement - *behind * scale;
        *behind += weight * agreement;
        const vf h = free_alpha * to_alpha;
        const vf hy = h * dy;
        sum_h += h;
        sum_hy += hy;
        sum_hyy += hy * dy;
    }
    vf sums[stride];
    sums[0] = sum_h;
    sums[1] = sum_h * dx;
    sums[2] = sum_hy;
    sums[3] = sums[1] * dx;
    sums[4] = sum_hy * dx;
    sums[5] = sum_hyy;
    for (int c = 0; c < stride - kRecordHead; c++) sums[kRecordHead + c] = c < V ? to_value[c < V ? c : 0] : all(0.f);
    for (int c = 0; c < stride; c += 8) store_sums(slot + c, sums + c);
}

template <int V>
static void composite_backward_values(Frame& frame, const ImageGradients& from, int channels) {
    constexpr int stride = (kRecordHead + V + 7) / 8 * 8;
    float* slots = frame.slots.reserve(frame.pairs * stride);
    const int tiles = frame.tiles();
    auto body = [&](int group) {
        TileGradients<V> state;
        for (int i = group * kTileGrain; i < lower(tiles, (group + 1) * kTileGrain); i++) {
            const int number = (int)frame.tile_order.data()[i];
            const Pair* list = frame.list.data() + frame.tile_start.data()[number];
            const int count = (int)(frame.tile_start.data()[number + 1] - frame.tile_start.data()[number]);
            if (count == 0) continue;
            const Tile tile = tile_at(frame, number);
            const int end = lower(count, load_tile<V>(frame, tile, from, channels, state));
            for (int k = higher(0, end); k < count; k++) std::memset(slots + (size_t)list[k].slot * stride, 0, stride * 4);
            for (int k = end - 1; k >= 0; k--) {
                if (k >= 8) {
                    prefetch_record(frame, list[k - 8].gaussian, V);
                    __builtin_prefetch(slots + (size_t)list[k - 8].slot * stride, 1);
                }
                const float* record = frame.records.data() + (size_t)list[k].gaussian * frame.record_stride;
                backward_pair<V>(record, list[k], k, tile, state, slots + (size_t)list[k].slot * stride);
            }
        }
    };
    parallel_for((tiles + kTileGrain - 1) / kTileGrain, body);
}

}  // namespace NEECO_VARIANT
}  // namespace neeco
