// Stage 4: blending, front to back, one tile at a time.
#pragma once

#include "kernels.hpp"
#include "parallel.hpp"
#include "simd.hpp"

namespace neeco {
namespace NEECO_VARIANT {

constexpr int kTilePixels = kStrip * kTileHeight;
constexpr int kTileGrain = 4, kAhead = 16;

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

// A row of a tile to or from an image; most are whole.
template <class T>
NEECO_INLINE void copy_strip_row(T* to, const T* from, int width) {
    if (width == kStrip) std::memcpy(to, from, 4 * kStrip);
    else for (int x = 0; x < width; x++) to[x] = from[x];
}

NEECO_INLINE void prefetch_record(const Frame& frame, uint32_t gaussian, int values) {
    const float* record = frame.records.data() + (size_t)gaussian * frame.record_stride;
    for (int i = 0; i < kRecordHead + values; i += 16) __builtin_prefetch(record + i);
}

// A tile is blended block by block, a block being what one vector covers, and its list in batches whose records stay in the
// innermost cache: a block's sums then stay in registers while it takes what the batch holds for it.
constexpr int kBlocks = kTileHeight / kRows, kBatch = 64;
static_assert(kBlocks == 32, "a pair's blocks are the bits of a word");
NEECO_INLINE uint32_t blocks_of(const Pair& pair) {
    const int first = pair.first_row / kRows, end = (pair.end_row + kRows - 1) / kRows;
    return 0xffffffffu >> (32 - (end - first)) << first;
}

// open: what would be left of the light, were pixels never full: it only falls, so one comparison tells what is drawn, and
// the chain from one Gaussian to the next is a single multiplication. 0 from the batch on in which the pixel was full.
template <int V>
struct TileState {
    alignas(64) float open[kTilePixels], transmittance[kTilePixels];
    alignas(64) float sums[kBlocks][V + 1][W];  // of weight * value, then of weights: 1 - transmittance would lose faint
                                                // alphas' digits, and depth with them
    alignas(64) int32_t last[kTilePixels];      // one more than the place in the list of what was blended last
};

// What the Gaussians of a batch are to one tile: log2(alpha) = (c dy + linear[x]) dy + constant[x], dy from y.
template <int V>
struct Batch {
    struct Entry {
        vs constant, linear;
        float y, c, values[V];
    };
    Entry entry[kBatch];
    uint64_t of_block[kBlocks];  // bits: the entries that reach into each block
};

// Bit k of word i becomes bit i of word k.
template <int Width>
NEECO_INLINE void swap_bits(uint32_t* words, uint32_t mask) {
    for (int from = 0; from < 32; from += 2 * Width)
        for (int k = from; k < from + Width; k++) {
            const uint32_t swapped = (words[k] >> Width ^ words[k + Width]) & mask;
            words[k] ^= swapped << Width;
            words[k + Width] ^= swapped;
        }
}
NEECO_INLINE void transpose_bits(uint32_t* words) {
    swap_bits<16>(words, 0x0000ffff);
    swap_bits<8>(words, 0x00ff00ff);
    swap_bits<4>(words, 0x0f0f0f0f);
    swap_bits<2>(words, 0x33333333);
    swap_bits<1>(words, 0x55555555);
}

template <int V>
static void load_batch(const Frame& frame, const Tile& tile, const Pair* list, int from, int count, Batch<V>& batch) {
    uint32_t blocks[2][32] = {};
    const vs columns = strip_iota();
    for (int i = 0; i < lower(kBatch, count - from); i++) {
        const Pair& pair = list[from + i];
        if (from + i + kAhead < count) prefetch_record(frame, list[from + i + kAhead].gaussian, V);
        const float* record = frame.records.data() + (size_t)pair.gaussian * frame.record_stride;
        const Record& g = *(const Record*)record;
        typename Batch<V>::Entry& entry = batch.entry[i];
        const vs dx = columns + ((float)tile.x + 0.5f - g.x);
        entry.constant = g.a * dx * dx + g.log2_opacity;
        entry.linear = g.b * dx;
        entry.y = g.y;
        entry.c = g.c;
        for (int c = 0; c < V; c++) entry.values[c] = record[kRecordHead + c];
        blocks[i / 32][i % 32] = blocks_of(pair);
    }
    for (auto& half : blocks) transpose_bits(half);
    for (int b = 0; b < kBlocks; b++) batch.of_block[b] = (uint64_t)blocks[1][b] << 32 | blocks[0][b];
}

// Keep: remember how far each pixel took from the list, for the backward pass. Returns whether any pixel takes more.
template <int V, bool Keep>
NEECO_INLINE bool blend_block(const Tile& tile, const Batch<V>& batch, int block, int from, TileState<V>& s) {
    vf open = *(vf*)(s.open + block * W), transmittance = *(vf*)(s.transmittance + block * W), sums[V + 1];
    vi last = all(0);
    if (Keep) last = *(vi*)(s.last + block * W);
    for (int c = 0; c <= V; c++) sums[c] = *(vf*)s.sums[block][c];
    const vf y = lane_y() + ((float)(block * kRows + tile.y) + 0.5f);
    for (uint64_t left = batch.of_block[block]; left; left &= left - 1) {
        const int i = __builtin_ctzll(left);
        const typename Batch<V>::Entry& g = batch.entry[i];
        const vf dy = y - g.y;
        const vf exponent = (g.c * dy + both_rows(g.linear)) * dy + both_rows(g.constant);
        const vf alpha = select(exponent >= kLog2Faintest, lower(exp2_fast(exponent), all(kOpaque)), all(0.f));
        vf weight = open * alpha;
        open *= 1.f - alpha;
        const vi drawn = open > kFull;
        weight = select(drawn, weight, all(0.f));
        transmittance = select(drawn, open, transmittance);
        if (Keep) last = select(drawn, all(from + i + 1), last);
        for (int c = 0; c < V; c++) sums[c] += weight * g.values[c];
        sums[V] += weight;
    }
    const vi takes = open > kFull;
    *(vf*)(s.open + block * W) = select(takes, open, all(0.f));
    *(vf*)(s.transmittance + block * W) = transmittance;
    if (Keep) *(vi*)(s.last + block * W) = last;
    for (int c = 0; c <= V; c++) *(vf*)s.sums[block][c] = sums[c];
    return any(takes);
}

template <int V, bool Keep>
static void blend_tile(const Frame& frame, const Tile& tile, const Pair* list, int count, TileState<V>& s) {
    for (int i = 0; i < kTilePixels; i++) {
        s.open[i] = i % kStrip < tile.width && i / kStrip < tile.height ? 1.f : 0.f;
        s.transmittance[i] = 1.f;
    }
    std::memset(s.sums, 0, sizeof s.sums);
    std::memset(s.last, 0, sizeof s.last);
    Batch<V> batch;
    uint32_t live = 0xffffffffu >> (32 - (tile.height + kRows - 1) / kRows);
    for (int from = 0; from < count && live; from += kBatch) {
        load_batch(frame, tile, list, from, count, batch);
        for (uint32_t left = live; left; left &= left - 1) {
            const int block = __builtin_ctz(left);
            if (batch.of_block[block] && !blend_block<V, Keep>(tile, batch, block, from, s)) live &= ~(1u << block);
        }
    }
}

// Values are worked out a block at a time, then go out row by row.
template <int V, bool Keep>
static void write_tile(Frame& frame, const Tile& tile, TileState<V>& s, const Images& out, int channels) {
    for (int block = 0; block < (tile.height + kRows - 1) / kRows; block++) {
        const vf left = *(vf*)(s.transmittance + block * W), alpha = *(vf*)s.sums[block][V];
        if (out.background)
            for (int c = 0; c < 3; c++) *(vf*)s.sums[block][c] += left * out.background[c];
        *(vf*)s.sums[block][3] = select(alpha > 0.f, *(vf*)s.sums[block][3] / alpha, all(0.f));
    }
    for (int y = 0; y < tile.height; y++) {
        const size_t start = (size_t)(tile.y + y) * frame.camera.width + tile.x;
        const float(*sums)[W] = s.sums[y / kRows];
        const int lane = y % kRows * kStrip;
        for (int x = 0; x < tile.width; x++)
            for (int c = 0; c < 3; c++) out.color[3 * (start + x) + c] = sums[c][lane + x];
        copy_strip_row(out.alpha + start, sums[V] + lane, tile.width);
        copy_strip_row(out.depth + start, sums[3] + lane, tile.width);
        for (int x = 0; x < tile.width; x++)
            for (int c = 0; c < channels; c++) out.channels[(start + x) * channels + c] = sums[4 + c][lane + x];
        if (Keep) {
            copy_strip_row(frame.transmittance.data() + start, s.transmittance + y * kStrip, tile.width);
            copy_strip_row(frame.last.data() + start, s.last + y * kStrip, tile.width);
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
