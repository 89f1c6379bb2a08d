// Stage 1: Gaussians to records, and the pieces of tiles each one may touch.
#pragma once

#include "geometry.hpp"
#include "parallel.hpp"
#include "sh.hpp"

namespace neeco {
namespace NEECO_VARIANT {

// The ellipse outside which alpha < 1/255. Its upper edge above column offset d is slope d + sqrt(k0 - k1 d^2).
struct Ellipse {
    float x, y, half_width, half_height, slope, k0, k1, peak;  // peak: offset of the highest point
};

// Emits, for every strip of columns and every tile row, the exact rows that the ellipse covers (with 1e-3 px to spare:
// compositing decides alone what is drawn). Returns the number of pieces written to `out`.
NEECO_INLINE uint32_t emit_pieces(const Frame& frame, const Ellipse& g, uint32_t* out) {
    const float width = (float)frame.camera.width, height = (float)frame.camera.height;
    const float left = higher(0.f, g.x - g.half_width - 0.501f), right = lower(width - 1.f, g.x + g.half_width - 0.499f);
    if (!(right >= left)) return 0;
    int first_x = (int)left;
    if ((float)first_x < left) first_x++;
    const int last_x = (int)right;
    if (last_x < first_x) return 0;
    const int first_strip = first_x / kStrip, last_strip = last_x / kStrip;
    uint32_t n = 0;
    for (int base = first_strip; base <= last_strip; base += W) {
        const vf column = (iota() + (float)base) * (float)kStrip - g.x;
        const vf from = higher(column + 0.5f, all(-g.half_width));
        const vf to = higher(lower(column + (kStrip - 0.5f), all(g.half_width)), from);
        const vf at_top = lower(higher(all(g.peak), from), to), at_bottom = lower(higher(all(-g.peak), from), to);
        const vf top = g.y + g.slope * at_top + root(higher(all(0.f), g.k0 - g.k1 * at_top * at_top));
        const vf bottom = g.y + g.slope * at_bottom - root(higher(all(0.f), g.k0 - g.k1 * at_bottom * at_bottom));
        const vf low = lower(higher(bottom - 0.501f, all(0.f)), all(height));
        const vf high = lower(higher(top - 0.499f, all(-1.f)), all(height - 1.f));
        vi first = to_int(low);
        first -= to_float(first) < low;                // ceil
        const vi last = to_int(high + 1.f) - 1;        // floor
        int32_t firsts[W], lasts[W];
        std::memcpy(firsts, &first, sizeof first);
        std::memcpy(lasts, &last, sizeof last);
        const int strips = lower(W, last_strip - base + 1);
        for (int i = 0; i < strips; i++) {
            const int a = firsts[i], b = lasts[i];
            if (a > b) continue;
            for (int row = a / kTileHeight; row <= b / kTileHeight; row++) {
                const int y0 = higher(a - row * kTileHeight, 0), y1 = lower(b - row * kTileHeight, kTileHeight - 1);
                out[n++] = (uint32_t)(row * frame.tiles_x + base + i) | (uint32_t)y0 << kTileBits |
                           (uint32_t)y1 << (kTileBits + kRowBits);
            }
        }
    }
    return n;
}

// Projects W Gaussians of which the first `live` are real.
NEECO_INLINE void project_batch(Frame& frame, const GaussianInputs& in, Chunk& chunk, const int* index, int live, float* radii) {
    const Camera& c = frame.camera;
    const Projected p = project_lanes(c, in, index);
    const vf opacity = gather(in.opacities, index, 1);
    vi seen = p.usable & finite(opacity) & (opacity >= 1.f / 255.f);
    const vf log2_opacity = log2_fast(higher(opacity, all(1e-30f)));
    const vf reach = 2.f * kLn2 * (log2_opacity - kLog2Faintest);  // squared Mahalanobis radius of alpha = 1/255
    const vf half_width = root(reach * p.cov_xx), half_height = root(reach * p.cov_yy);
    const vf x = c.fx * p.x * p.inverse_z + c.cx, y = c.fy * p.y * p.inverse_z + c.cy;
    seen &= finite(x) & finite(y) & finite(half_width) & finite(half_height);
    seen &= (x + half_width > 0.f) & (x - half_width < (float)c.width) & (y + half_height > 0.f) &
            (y - half_height < (float)c.height);
    Span* spans = frame.spans.data();
    if (!any(seen)) {
        for (int i = 0; i < live; i++) {
            spans[index[i]] = {chunk.piece_count, 0};
            radii[index[i]] = 0;
        }
        return;
    }
    const vf inverse_det = 1.f / p.det, inverse_xx = 1.f / p.cov_xx;
    const vf half_trace = 0.5f * (p.cov_xx + p.cov_yy), half_gap = 0.5f * (p.cov_xx - p.cov_yy);
    const vf radius = 3.f * root(half_trace + root(half_gap * half_gap + p.cov_xy * p.cov_xy));
    const vf peak = p.cov_xy * root(reach / p.cov_yy);
    vf basis[16];
    if (in.sh_count > 1) sh_basis(in.sh_count, direction_lanes(c, in, p, index).local, basis);
    else basis[0] = all(kSh0);
    const vf light = in.falloff ? light_lanes(in, p, index).factor : all(1.f);
    const vf a = -0.5f * kLog2E * p.cov_yy * inverse_det, b = kLog2E * p.cov_xy * inverse_det,
             cc = -0.5f * kLog2E * p.cov_xx * inverse_det, slope = p.cov_xy * inverse_xx;
    const vf k0 = reach * p.det * inverse_xx, k1 = p.det * inverse_xx * inverse_xx;

    for (int i = 0; i < live; i++) {
        const int g = index[i];
        spans[g] = {chunk.piece_count, 0};
        radii[g] = 0;
        if (!seen[i]) continue;
        float color[3] = {0.5f, 0.5f, 0.5f};
        const float* sh = in.sh + (size_t)g * in.sh_count * 3;
        for (int k = 0; k < in.sh_count; k++)
            for (int ch = 0; ch < 3; ch++) color[ch] += basis[k][i] * sh[3 * k + ch];
        if (!finite(color[0]) || !finite(color[1]) || !finite(color[2]) || !finite(light[i])) continue;
        float* record = frame.records.data() + (size_t)g * frame.record_stride;
        bool drawable = true;
        for (int ch = 0; ch < in.channel_count; ch++) {
            const float v = in.channels[(size_t)g * in.channel_count + ch];
            drawable &= finite(v);
            record[kRecordHead + 4 + ch] = v;
        }
        if (!drawable) continue;
        uint32_t* out = chunk.pieces.grow((size_t)chunk.piece_count + frame.tiles()) + chunk.piece_count;
        const Ellipse ellipse{x[i], y[i], half_width[i], half_height[i], slope[i], k0[i], k1[i], peak[i]};
        const uint32_t n = emit_pieces(frame, ellipse, out);
        if (n == 0) continue;
        chunk.piece_count += n;
        spans[g].count = n;
        radii[g] = radius[i];
        *(Record*)record = {x[i], y[i], a[i], b[i], cc[i], log2_opacity[i]};
        for (int ch = 0; ch < 3; ch++) record[kRecordHead + ch] = higher(color[ch], 0.f) * light[i];
        record[kRecordHead + 3] = p.z[i];
        for (int ch = 4 + in.channel_count; ch < frame.values; ch++) record[kRecordHead + ch] = 0;
        uint32_t key;
        const float z = p.z[i];
        std::memcpy(&key, &z, 4);
        const size_t at = (size_t)(g >> kChunkBits << kChunkBits) + chunk.visible;
        frame.spare_keys.data()[at] = key;
        frame.spare_order.data()[at] = (uint32_t)g;
        if (chunk.visible++ == 0) chunk.lowest_key = chunk.highest_key = key;
        if (key < chunk.lowest_key) chunk.lowest_key = key;
        if (key > chunk.highest_key) chunk.highest_key = key;
    }
}

static void project(Frame& frame, const GaussianInputs& in, float* radii) {
    const int count = in.count;
    auto body = [&](int number) {
        Chunk& chunk = frame.chunks[number];
        chunk.piece_count = chunk.visible = 0;
        const int end = lower(count, (number + 1) << kChunkBits);
        for (int i = number << kChunkBits; i < end; i += W) {
            int index[W];
            for (int k = 0; k < W; k++) index[k] = lower(i + k, count - 1);
            project_batch(frame, in, chunk, index, lower(W, end - i), radii);
        }
    };
    parallel_for((count + kChunk - 1) / kChunk, body);
}

}  // namespace NEECO_VARIANT
}  // namespace neeco
