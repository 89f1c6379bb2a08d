// Stages 2 and 3: the visible Gaussians in depth order, then listed per tile in that order.
//
// Order: by float32 depth, equal depths by index. Both sorts are stable counting sorts, so the lists do not depend on how
// many parts the work was cut into.
#include <algorithm>
#include <cstring>

#include "kernels.hpp"
#include "parallel.hpp"

namespace neeco {

template class Buffer<uint32_t>;
template class Buffer<int32_t>;
template class Buffer<float>;
template class Buffer<double>;
template class Buffer<Pair>;
template class Buffer<Span>;

namespace {

constexpr int kDigitBits = 11, kDigits = 1 << kDigitBits;

int parts_for(size_t items) { return static_cast<int>(std::clamp<size_t>(items / 8192, 1, thread_count())); }

// Turns counts [part][bin] into first positions, bins outermost.
void positions_from_counts(uint32_t* counts, int parts, int bins) {
    uint32_t sum = 0;
    for (int bin = 0; bin < bins; bin++)
        for (int part = 0; part < parts; part++) {
            uint32_t& cell = counts[static_cast<size_t>(part) * bins + bin];
            const uint32_t n = cell;
            cell = sum;
            sum += n;
        }
}

// Moves the chunks' visible Gaussians together and returns the lowest and highest key.
std::pair<uint32_t, uint32_t> compact(Frame& f) {
    uint32_t lowest = 0xffffffffu, highest = 0;
    size_t n = 0;
    uint32_t* keys = f.keys.reserve(f.count);
    uint32_t* order = f.order.reserve(f.count);
    for (size_t c = 0; c < f.chunks.size(); c++) {
        const Chunk& chunk = f.chunks[c];
        if (chunk.visible == 0) continue;
        std::memcpy(keys + n, f.spare_keys.data() + c * kChunk, chunk.visible * 4);
        std::memcpy(order + n, f.spare_order.data() + c * kChunk, chunk.visible * 4);
        n += chunk.visible;
        lowest = std::min(lowest, chunk.lowest_key);
        highest = std::max(highest, chunk.highest_key);
    }
    f.visible = n;
    return {lowest, highest};
}

}  // namespace

void sort_by_depth(Frame& f) {
    const auto [lowest, highest] = compact(f);
    const size_t n = f.visible;
    if (n == 0) return;
    const int parts = parts_for(n);
    uint32_t* histogram = f.histogram.reserve(static_cast<size_t>(parts) * kDigits);
    uint32_t *keys = f.keys.data(), *order = f.order.data();
    uint32_t *next_keys = f.spare_keys.data(), *next_order = f.spare_order.data();
    bool swapped = false;
    for (int shift = 0; shift < 32 && ((highest - lowest) >> shift) != 0; shift += kDigitBits) {
        parallel_for(parts, [&](int part) {
            uint32_t* h = histogram + static_cast<size_t>(part) * kDigits;
            std::memset(h, 0, kDigits * 4);
            for (size_t i = n * part / parts; i < n * (part + 1) / parts; i++) h[((keys[i] - lowest) >> shift) & (kDigits - 1)]++;
        });
        positions_from_counts(histogram, parts, kDigits);
        parallel_for(parts, [&](int part) {
            uint32_t* h = histogram + static_cast<size_t>(part) * kDigits;
            for (size_t i = n * part / parts; i < n * (part + 1) / parts; i++) {
                const uint32_t at = h[((keys[i] - lowest) >> shift) & (kDigits - 1)]++;
                next_keys[at] = keys[i];
                next_order[at] = order[i];
            }
        });
        std::swap(keys, next_keys);
        std::swap(order, next_order);
        swapped = !swapped;
    }
    if (swapped) {
        std::swap(f.keys, f.spare_keys);
        std::swap(f.order, f.spare_order);
    }
}

void list_per_tile(Frame& f) {
    const int tiles = f.tiles();
    uint32_t slots = 0;
    for (Chunk& chunk : f.chunks) {
        chunk.base = slots;
        slots += chunk.piece_count;
    }
    f.pairs = slots;
    Pair* list = f.list.reserve(slots);
    uint32_t* start = f.tile_start.reserve(static_cast<size_t>(tiles) + 1);
    const size_t n = f.visible;
    const int parts = parts_for(n);
    uint32_t* histogram = f.histogram.reserve(static_cast<size_t>(parts) * std::max(tiles, kDigits));
    const uint32_t* order = f.order.data();
    const Span* spans = f.spans.data();
    constexpr uint32_t tile_mask = (1u << kTileBits) - 1, row_mask = (1u << kRowBits) - 1;
    constexpr size_t ahead = 12;
    auto pieces_of = [&](uint32_t g) { return f.chunks[g >> kChunkBits].pieces.data() + spans[g].first; };
    auto prefetch = [&](size_t i, size_t end) {
        if (i + 2 * ahead < end) __builtin_prefetch(spans + order[i + 2 * ahead]);
        if (i + ahead < end) __builtin_prefetch(pieces_of(order[i + ahead]));
    };
    parallel_for(parts, [&](int part) {
        uint32_t* h = histogram + static_cast<size_t>(part) * tiles;
        std::memset(h, 0, static_cast<size_t>(tiles) * 4);
        const size_t end = n * (part + 1) / parts;
        for (size_t i = n * part / parts; i < end; i++) {
            prefetch(i, end);
            const uint32_t* piece = pieces_of(order[i]);
            for (uint32_t k = 0; k < spans[order[i]].count; k++) h[piece[k] & tile_mask]++;
        }
    });
    positions_from_counts(histogram, parts, tiles);
    for (int t = 0; t < tiles; t++) start[t] = histogram[t];
    start[tiles] = slots;
    parallel_for(parts, [&](int part) {
        uint32_t* h = histogram + static_cast<size_t>(part) * tiles;
        const size_t end = n * (part + 1) / parts;
        for (size_t i = n * part / parts; i < end; i++) {
            prefetch(i, end);
            const uint32_t g = order[i], count = spans[g].count;
            const uint32_t* piece = pieces_of(g);
            uint32_t slot = f.chunks[g >> kChunkBits].base + spans[g].first;
            for (uint32_t k = 0; k < count; k++) {
                const uint32_t word = piece[k];
                const auto first = static_cast<uint16_t>((word >> kTileBits) & row_mask);
                const auto end_row = static_cast<uint16_t>((word >> (kTileBits + kRowBits)) + 1);
                list[h[word & tile_mask]++] = {g, slot++, first, end_row};
            }
        }
    });

    // The fullest tiles first, so that the threads finish together.
    constexpr uint32_t classes = 256;
    auto class_of = [&](int t) { return classes - 1 - std::min((start[t + 1] - start[t]) / 16, classes - 1); };
    uint32_t first[classes] = {};
    for (int t = 0; t < tiles; t++) first[class_of(t)]++;
    positions_from_counts(first, 1, classes);
    uint32_t* tile_order = f.tile_order.reserve(tiles);
    for (int t = 0; t < tiles; t++) tile_order[first[class_of(t)]++] = static_cast<uint32_t>(t);
}

}  // namespace neeco
