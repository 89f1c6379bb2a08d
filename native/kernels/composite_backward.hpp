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
    alignas(64) float wanted[kBlocks][V][W];
    alignas(64) int32_t last[kTilePixels];
    int32_t end[kBlocks];                   // the greatest of a block's `last`
};

// Loads the image gradients of one tile, row by row, then works out the rest block by block. Returns the greatest `last`.
template <int V>
static int load_tile(const Frame& frame, const Tile& tile, const ImageGradients& from, int channels, TileGradients<V>& s) {
    alignas(64) float alpha[kTilePixels];
    std::memset(&s, 0, sizeof s);
    std::memset(alpha, 0, sizeof alpha);
    for (int y = 0; y < tile.height; y++) {
        const size_t start = (size_t)(tile.y + y) * frame.camera.width + tile.x;
        float(*wanted)[W] = s.wanted[y / kRows];
        const int lane = y % kRows * kStrip;
        copy_strip_row(s.transmittance + y * kStrip, frame.transmittance.data() + start, tile.width);
        copy_strip_row(s.last + y * kStrip, frame.last.data() + start, tile.width);
        copy_strip_row(s.depth + y * kStrip, from.drawn_depth + start, tile.width);
        copy_strip_row(alpha + y * kStrip, from.drawn_alpha + start, tile.width);
        if (from.alpha) copy_strip_row(s.behind + y * kStrip, from.alpha + start, tile.width);
        if (from.depth) copy_strip_row(wanted[3] + lane, from.depth + start, tile.width);
        if (from.color)
            for (int x = 0; x < tile.width; x++)
                for (int c = 0; c < 3; c++) wanted[c][lane + x] = from.color[3 * (start + x) + c];
        if (from.channels)
            for (int x = 0; x < tile.width; x++)
                for (int c = 0; c < channels; c++) wanted[4 + c][lane + x] = from.channels[(start + x) * channels + c];
    }
    int highest = 0;
    for (int block = 0; block < kBlocks; block++) {
        vf* wanted = (vf*)s.wanted[block];
        const vf drawn = *(vf*)(alpha + block * W);
        // depth = sum of weight * z / alpha, so d depth / d weight = (z - depth) / alpha
        wanted[3] = select(drawn > 0.f, wanted[3] / drawn, all(0.f));
        vf behind = -*(vf*)(s.behind + block * W);
        if (from.background)
            for (int c = 0; c < 3; c++) behind += from.background[c] * wanted[c];
        *(vf*)(s.behind + block * W) = behind * *(vf*)(s.transmittance + block * W);
        for (int i = 0; i < W; i++) s.end[block] = higher(s.end[block], s.last[block * W + i]);
        highest = higher(highest, s.end[block]);
    }
    return highest;
}

template <int V>
NEECO_INLINE void backward_pair(const float* record, uint32_t blocks, int k, const Tile& tile, TileGradients<V>& s, float* slot) {
    constexpr int stride = (kRecordHead + V + 7) / 8 * 8;
    const Record& g = *(const Record*)record;
    vf value[V], to_value[V];
    for (int c = 0; c < V; c++) {
        value[c] = all(record[kRecordHead + c]);
        to_value[c] = all(0.f);
    }
    const vf dx = lane_x() + ((float)tile.x + 0.5f - g.x);
    const vf constant = g.a * dx * dx + g.log2_opacity, linear = g.b * dx;
    const vf top = lane_y() + ((float)tile.y + 0.5f - g.y);
    vf sum_h = all(0.f), sum_hy = all(0.f), sum_hyy = all(0.f);
    for (; blocks; blocks &= blocks - 1) {
        const int row = __builtin_ctz(blocks);
        const vf dy = top + (float)(row * kRows);
        const vf exponent = (g.c * dy + linear) * dy + constant;
        const vf raw = exp2_fast(exponent);
        const vi drawn = (exponent >= kLog2Faintest) & (*(const vi*)(s.last + row * W) > k);
        const vf alpha = select(drawn, lower(raw, all(kOpaque)), all(0.f));
        vf* transmittance = (vf*)(s.transmittance + row * W);
        vf* behind = (vf*)(s.behind + row * W);
        const vf after = *transmittance;
        const vf* wanted = (const vf*)s.wanted[row];
        // z and depth nearly cancel: subtract them before anything is rounded
        vf agreement = (value[3] - *(const vf*)(s.depth + row * W)) * wanted[3];
        for (int c = 0; c < V; c++)
            if (c != 3) agreement += value[c] * wanted[c];
        const vf gain = after * agreement - *behind;  // dL/dalpha (1 - alpha)
        const vf scale = reciprocal(1.f - alpha), share = alpha * scale;
        const vf weight = share * after;
        *transmittance = after * scale;
        *behind += weight * agreement;
        for (int c = 0; c < V; c++) to_value[c] += weight * wanted[c];
        const vf h = select(raw <= kOpaque, share * gain, all(0.f));
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
            const int end = load_tile<V>(frame, tile, from, channels, state);
            for (int k = end; k < count; k++) std::memset(slots + (size_t)list[k].slot * stride, 0, stride * 4);
            uint32_t live = 0;  // blocks any pixel of which took the k-th of the list or a later one
            for (int k = end - 1, next = end; k >= 0; k--) {
                if (k < next) {
                    next = 0;
                    for (int block = 0; block < kBlocks; block++) {
                        if (state.end[block] > k) live |= 1u << block;
                        else next = higher(next, state.end[block]);
                    }
                }
                if (k >= 8) {
                    prefetch_record(frame, list[k - 8].gaussian, V);
                    __builtin_prefetch(slots + (size_t)list[k - 8].slot * stride, 1);
                }
                const float* record = frame.records.data() + (size_t)list[k].gaussian * frame.record_stride;
                backward_pair<V>(record, blocks_of(list[k]) & live, k, tile, state, slots + (size_t)list[k].slot * stride);
            }
        }
    };
    parallel_for((tiles + kTileGrain - 1) / kTileGrain, body);
}

}  // namespace NEECO_VARIANT
}  // namespace neeco
