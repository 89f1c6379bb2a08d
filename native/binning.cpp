// Stage 2: the visible Gaussians listed per tile, near to far.
//
// Order: by float32 depth, equal depths by index. The image is cut into bands of tile columns; each is gathered, sorted
// and listed by one task, in memory that fits into that core's cache and without waiting for the others. Sorts are
// stable, and bands do not depend on the number of threads: nor do the lists.
#include <algorithm>
#include <cstring>

#include "kernels.hpp"
#include "parallel.hpp"

namespace neeco {
namespace {

constexpr int kDigitBits = 11, kDigits = 1 << kDigitBits, kPasses = 3;  // 3 x 11 bits hold any 32-bit key
constexpr uint32_t kTileMask = (1u << kTileBits) - 1, kRowMask = (1u << kRowBits) - 1;
constexpr size_t kAhead = 12;

uint32_t band_tiles(const Frame& f) { return static_cast<uint32_t>(f.band_columns * f.tiles_y); }

// Turns counts into first positions, the first of which is `from`; returns the end.
uint32_t positions_from_counts(uint32_t* counts, size_t bins, uint32_t from = 0) {
    for (size_t bin = 0; bin < bins; bin++) {
        const uint32_t n = counts[bin];
        counts[bin] = from;
        from += n;
    }
    return from;
}

// Copies a band's runs together, in Gaussian order, and counts the pieces of every tile. `from` is the band's first
// place in the frame's list. Returns the number of runs.
size_t gather_band(Frame& f, int number, uint32_t from) {
    Band& band = f.band[number];
    size_t runs = 0, pieces = 0;
    for (const Chunk& chunk : f.chunks) {
        runs += chunk.run_start[number + 1] - chunk.run_start[number];
        pieces += chunk.band_pieces[number];
    }
    Run* run = band.runs.reserve(runs);
    uint32_t *piece = band.pieces.reserve(pieces), *slot = band.slots.reserve(runs);
    const uint32_t first_tile = number * band_tiles(f);
    const uint32_t tiles = std::min<uint32_t>(band_tiles(f), f.tiles() - first_tile);
    uint32_t* counts = band.next.reserve(tiles);
    std::memset(counts, 0, tiles * 4);
    size_t r = 0;
    uint32_t p = 0;
    for (const Chunk& chunk : f.chunks)
        for (uint32_t i = chunk.run_start[number]; i < chunk.run_start[number + 1]; i++, r++) {
            const Run& from_chunk = chunk.runs.data()[i];
            run[r] = {from_chunk.key, from_chunk.gaussian, p, from_chunk.count};
            slot[r] = chunk.base + from_chunk.first;
            const uint32_t* word = chunk.pieces.data() + from_chunk.first;
            for (uint32_t k = 0; k < from_chunk.count; k++) {
                counts[(word[k] & kTileMask) - first_tile]++;
                piece[p++] = word[k];
            }
        }
    positions_from_counts(counts, tiles, from);
    std::memcpy(f.tile_start.data() + first_tile, counts, tiles * 4);
    return runs;
}

// Runs of a band, near to far: (key - lowest) << 32 | index. A stable radix sort; digits that are all alike are skipped.
const uint64_t* sort_band(Band& band, size_t n) {
    const Run* run = band.runs.data();
    uint64_t *order = band.order.reserve(n), *spare = band.spare.reserve(n);
    uint32_t lowest = 0xffffffffu, histogram[kPasses][kDigits] = {};
    for (size_t i = 0; i < n; i++) lowest = std::min(lowest, run[i].key);
    for (size_t i = 0; i < n; i++) {
        const uint32_t key = run[i].key - lowest;
        for (int pass = 0; pass < kPasses; pass++) histogram[pass][(key >> (pass * kDigitBits)) & (kDigits - 1)]++;
        order[i] = static_cast<uint64_t>(key) << 32 | i;
    }
    for (int pass = 0; pass < kPasses; pass++) {
        uint32_t* at = histogram[pass];
        if (at[0] == n) continue;
        positions_from_counts(at, kDigits);
        const int shift = 32 + pass * kDigitBits;
        for (size_t i = 0; i < n; i++) spare[at[(order[i] >> shift) & (kDigits - 1)]++] = order[i];
        std::swap(order, spare);
    }
    return order;
}

void list_band(Frame& f, int number, uint32_t from) {
    const size_t n = gather_band(f, number, from);
    Band& band = f.band[number];
    const uint64_t* order = sort_band(band, n);
    const Run* runs = band.runs.data();
    const uint32_t *pieces = band.pieces.data(), first_tile = number * band_tiles(f);
    uint32_t* next = band.next.data();
    Pair* list = f.list.data();
    auto run_at = [&](size_t i) { return static_cast<uint32_t>(order[i]); };
    for (size_t i = 0; i < n; i++) {
        if (i + 2 * kAhead < n) __builtin_prefetch(runs + run_at(i + 2 * kAhead));
        if (i + kAhead < n) __builtin_prefetch(pieces + runs[run_at(i + kAhead)].first);
        const Run run = runs[run_at(i)];
        uint32_t slot = band.slots.data()[run_at(i)];
        for (uint32_t k = 0; k < run.count; k++) {
            const uint32_t word = pieces[run.first + k];
            const auto first = static_cast<uint16_t>((word >> kTileBits) & kRowMask);
            const auto end_row = static_cast<uint16_t>((word >> (kTileBits + kRowBits)) + 1);
            list[next[(word & kTileMask) - first_tile]++] = {run.gaussian, slot++, first, end_row};
        }
    }
}

// The fullest tiles first, so that the threads finish together.
void order_tiles(Frame& f) {
    const int tiles = f.tiles();
    const uint32_t* start = f.tile_start.data();
    constexpr uint32_t classes = 256;
    auto class_of = [&](int t) { return classes - 1 - std::min((start[t + 1] - start[t]) / 16, classes - 1); };
    uint32_t first[classes] = {};
    for (int t = 0; t < tiles; t++) first[class_of(t)]++;
    positions_from_counts(first, classes);
    uint32_t* tile_order = f.tile_order.reserve(tiles);
    for (int t = 0; t < tiles; t++) tile_order[first[class_of(t)]++] = static_cast<uint32_t>(t);
}

}  // namespace

void group_by_band(Frame& f, int number) {
    Chunk& chunk = f.chunks[number];
    const uint32_t* pieces = chunk.pieces.data();
    const Visible* visible = f.visible_list.data() + (static_cast<size_t>(number) << kChunkBits);
    Run* loose = chunk.loose.reserve(static_cast<size_t>(chunk.visible) * f.bands);
    uint32_t next[kMostBands + 1] = {};
    std::memset(chunk.band_pieces, 0, sizeof chunk.band_pieces);
    auto band_of = [&](uint32_t piece) { return (pieces[piece] & kTileMask) / band_tiles(f); };
    uint32_t runs = 0;
    for (uint32_t i = 0; i < chunk.visible; i++) {
        const Span span = f.spans.data()[visible[i].gaussian];
        const uint32_t end = span.first + span.count, last_band = band_of(end - 1);
        for (uint32_t first = span.first; first < end;) {  // a Gaussian's pieces go from column to column
            const uint32_t band = band_of(first), limit = (band + 1) * band_tiles(f);
            uint32_t stop = end;
            if (band != last_band)
                for (stop = first + 1; (pieces[stop] & kTileMask) < limit;) stop++;
            loose[runs++] = {visible[i].key, visible[i].gaussian, first, stop - first};
            next[band]++;
            chunk.band_pieces[band] += stop - first;
            first = stop;
        }
    }
    positions_from_counts(next, kMostBands + 1);
    std::memcpy(chunk.run_start, next, sizeof next);
    Run* grouped = chunk.runs.reserve(runs);
    for (uint32_t i = 0; i < runs; i++) grouped[next[band_of(loose[i].first)]++] = loose[i];
}

void list_per_tile(Frame& f) {
    uint32_t slots = 0, starts[kMostBands + 1] = {};
    f.visible = 0;
    for (Chunk& chunk : f.chunks) {
        chunk.base = slots;
        slots += chunk.piece_count;
        f.visible += chunk.visible;
        for (int b = 0; b < f.bands; b++) starts[b] += chunk.band_pieces[b];
    }
    positions_from_counts(starts, kMostBands + 1);
    f.pairs = slots;
    f.list.reserve(slots);
    f.tile_start.reserve(static_cast<size_t>(f.tiles()) + 1)[f.tiles()] = slots;
    parallel_for(f.bands, [&](int band) { list_band(f, band, starts[band]); });
    order_tiles(f);
}

}  // namespace neeco
