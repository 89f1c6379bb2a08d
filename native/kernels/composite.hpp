// Stage 4: blending, front to back, one tile at a time.
#pragma once

#include "kernels.hpp"
#include "parallel.hpp"
#include "simd.hpp"

namespace neeco {
namespace NEECO_VARIANT {

constexpr int kTilePixels = kStrip * kTileHeight;
constexpr int kNever = 0x7fffffff;
constexpr int kTileGrain = 4;

NEECO_INLINE vf lane_x() {
    vf r;
    for (int i = 0; i < W; i++) r[i] = (float)(i % kStrip);
    return r;
}
NEECO_INLINE vf lane_y() {
    vf r;
    for (int i = 0; i < W; i++) r[i] = (float)(i / kStrip);
    return r;
}

// Where a tile lies in the image.
struct Tile {
    int x, y, width, height;
};
NEECO_INLINE Tile tile_at(const Frame& frame, int tile) {
    Tile t;
    t.x = tile / frame.tiles_y * kStrip;
    t.y = tile % frame.tiles_y * kTileHeight;
    t.width = lower(kStrip, frame.camera.width - t.x);
    t.height = lower(kTileHeight, frame.camera.height - t.y);
    return t;
}

NEECO_INLINE void prefetch_record(const Frame& frame, uint32_t gaussian, int values) {
    const float* record = frame.records.data() + (size_t)gaussian * frame.record_stride;
    for (int i = 0; i < kRecordHead + values; i += 16) __builtin_prefetch(record + i);
}

// transmittance: positive while the pixel takes more, negated once it is full, so that one comparison tells both.
template <int V>
struct TileState {
    alignas(64) float transmittance[kTilePixels];
    alignas(64) float sums[kTileHeight / kRows][V + 1][W];  // of weight * value, then of weights: 1 - transmittance
                                                            // would lose faint alphas' digits, and depth with them
    alignas(64) int32_t last[kTilePixels];
};

// Keep: remember where in the list each pixel became full, for the backward pass.
template <int V, bool Keep>
static void blend_tile(const Frame& frame, const Tile& tile, const Pair* list, int count, TileState<V>& s) {
    for (int i = 0; i < kTilePixels; i++) {
        s.transmittance[i] = i % kStrip < tile.width && i / kStrip < tile.height ? 1.f : -1.f;
        s.last[i] = kNever;
    }
    std::memset(s.sums, 0, sizeof s.sums);
    const vf lane_columns = lane_x(), lane_rows = lane_y();
    int live_from = 0, live_to = tile.height;
    vi filled = all(0);
    for (int k = 0; k < count; k++) {
        if (k + 8 < count) prefetch_record(frame, list[k + 8].gaussian, V);
        const float* record = frame.records.data() + (size_t)list[k].gaussian * frame.record_stride;
        const Record& g = *(const Record*)record;
        vf value[V];
        for (int c = 0; c < V; c++) value[c] = all(record[kRecordHead + c]);
        const int from = higher(list[k].first_row, live_from) / kRows;
        const int to = (lower(list[k].end_row, live_to) + kRows - 1) / kRows;
        const vf dx = lane_columns + ((float)tile.x + 0.5f - g.x);
        const vf constant = g.a * dx * dx + g.log2_opacity, linear = g.b * dx;
        vf dy = lane_rows + ((float)(from * kRows + tile.y) + 0.5f - g.y);
        for (int row = from; row < to; row++, dy += (float)kRows) {
            const vf exponent = (g.c * dy + linear) * dy + constant;
            const vf alpha = lower(exp2_fast(exponent), all(kOpaque));
            vf* transmittance = (vf*)(s.transmittance + row * W);
            const vf before = *transmittance;
            const vi offered = (exponent >= kLog2Faintest) & (before > 0.f);
            vf weight = before * alpha;
            const vi drawn = offered & (before - weight > kFull), full = offered ^ drawn;
            // No branch on `full`: it would be decided only at the end of the longest chain of dependent operations, and
            // every wrong guess would throw away the rows begun meanwhile.
            filled |= full;
            if (Keep) {
                vi* last = (vi*)(s.last + row * W);
                *last = select(full, all(k), *last);
            }
            weight = select(drawn, weight, all(0.f));
            vf* sums = (vf*)s.sums[row];
            for (int c = 0; c < V; c++) sums[c] += weight * value[c];
            sums[V] += weight;
            *transmittance = select(full, -before, before - weight);
        }
        if ((k & 7) == 7 && any(filled)) {  // rows that are full at both ends need no more visits
            filled = all(0);
            auto full_row = [&](int y) { return !any(*(vf*)(s.transmittance + y / kRows * W) > 0.f); };
            while (live_from < live_to && full_row(live_from)) live_from += kRows;
            while (live_to > live_from && full_row(live_to - 1)) live_to = (live_to - 1) / kRows * kRows;
            if (live_from >= live_to) break;
        }
    }
}

template <int V, bool Keep>
static void write_tile(Frame& frame, const Tile& tile, const TileState<V>& s, const Images& out, int channels) {
    const float* background = out.background;
    for (int y = 0; y < tile.height; y++)
        for (int x = 0; x < tile.width; x++) {
            const size_t pixel = (size_t)(tile.y + y) * frame.camera.width + tile.x + x;
            const int i = y * kStrip + x, lane = y % kRows * kStrip + x;
            const float(*sums)[W] = s.sums[y / kRows];
            const float left = s.transmittance[i] < 0 ? -s.transmittance[i] : s.transmittance[i], alpha = sums[V][lane];
            for (int c = 0; c < 3; c++) out.color[3 * pixel + c] = sums[c][lane] + (background ? left * background[c] : 0.f);
            out.alpha[pixel] = alpha;
            out.depth[pixel] = alpha > 0 ? sums[3][lane] / alpha : 0.f;
            for (int c = 0; c < channels; c++) out.channels[pixel * channels + c] = sums[4 + c][lane];
            if (Keep) {
                frame.transmittance.data()[pixel] = left;
                frame.last.data()[pixel] = s.last[i];
            }
        }
}

template <int V, bool Keep>
static void composite_values(Frame& frame, const Images& out, int channels) {
    const int tiles = frame.tiles();
    auto body = [&](int group) {
        TileState<V> state;
        for (int i = group * kTileGrain; i < lower(tiles, (group + 1) * kTileGrain); i++) {
            const int number = (int)frame.tile_order.data()[i];
            const uint32_t* start = frame.tile_start.data() + number;
            const Tile tile = tile_at(frame, number);
            blend_tile<V, Keep>(frame, tile, frame.list.data() + start[0], (int)(start[1] - start[0]), state);
            write_tile<V, Keep>(frame, tile, state, out, channels);
        }
    };
    parallel_for((tiles + kTileGrain - 1) / kTileGrain, body);
}

}  // namespace NEECO_VARIANT
}  // namespace neeco
