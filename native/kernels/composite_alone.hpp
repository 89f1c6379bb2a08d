// Some of a drawn frame's Gaussians without the others: alpha and depth. Projection and lists are those of the frame, and
// where a tile lists nothing else, so are the pixels.
#pragma once

#include <vector>

#include "composite.hpp"

namespace neeco {
namespace NEECO_VARIANT {

static void composite_alone(Frame& frame, const bool* chosen, const float* drawn_alpha, const float* drawn_depth, float* alpha, float* depth) {
    constexpr int V = 4;
    const int tiles = frame.tiles();
    auto body = [&](int group) {
        TileState<V> state;
        std::vector<Pair> own;
        for (int i = group * kTileGrain; i < lower(tiles, (group + 1) * kTileGrain); i++) {
            const int number = (int)frame.tile_order.data()[i];
            const Tile tile = tile_at(frame, number);
            const Pair* list = frame.list.data();
            const uint32_t start = frame.tile_start.data()[number], end = frame.tile_start.data()[number + 1];
            own.clear();
            for (uint32_t k = start; k < end; k++)
                if (chosen[list[k].gaussian]) own.push_back(list[k]);
            const bool all_of_it = own.size() == end - start;
            if (!all_of_it) blend_tile<V, false>(frame, tile, own.data(), (int)own.size(), state);
            for (int y = 0; y < tile.height; y++) {
                const size_t at = (size_t)(tile.y + y) * frame.camera.width + tile.x;
                if (all_of_it) {
                    copy_strip_row(alpha + at, drawn_alpha + at, tile.width);
                    copy_strip_row(depth + at, drawn_depth + at, tile.width);
                    continue;
                }
                const float(*sums)[W] = state.sums[y / kRows];
                const int lane = y % kRows * kStrip;
                for (int x = 0; x < tile.width; x++) {
                    const float opacity = sums[V][lane + x];
                    alpha[at + x] = opacity;
                    depth[at + x] = opacity > 0.f ? sums[3][lane + x] / opacity : 0.f;
                }
            }
        }
    };
    parallel_for((tiles + kTileGrain - 1) / kTileGrain, body);
}

}  // namespace NEECO_VARIANT
}  // namespace neeco
