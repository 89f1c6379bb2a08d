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
    for (int base = first_strip; base <= last_strip; base += kStrip) {  // as many strips at a time as a strip has columns
        const vs column = (strip_iota() + (float)base) * (float)kStrip - g.x, zero = {};
        const vs from = higher(column + 0.5f, zero - g.half_width);
        const vs to = higher(lower(column + (kStrip - 0.5f), zero + g.half_width), from);
        const vs at_top = lower(higher(zero + g.peak, from), to), at_bottom = lower(higher(zero - g.peak, from), to);
        const vs top = g.y + g.slope * at_top + root(higher(zero, g.k0 - g.k1 * at_top * at_top));
        const vs bottom = g.y + g.slope * at_bottom - root(higher(zero, g.k0 - g.k1 * at_bottom * at_bottom));
        const vs low = lower(higher(bottom - 0.501f, zero), zero + height);
        const vs high = lower(higher(top - 0.499f, zero - 1.f), zero + (height - 1.f));
        vsi first = __builtin_convertvector(low, vsi);
        first -= __builtin_convertvector(first, vs) < low;            // ceil
        const vsi last = __builtin_convertvector(high + 1.f, vsi) - 1;  // floor
        int32_t firsts[kStrip], lasts[kStrip];
        std::memcpy(firsts, &first, sizeof first);
        std::memcpy(lasts, &last, sizeof last);
        const int strips = lower(kStrip, last_strip - base + 1);
        for (int i = 0; i < strips; i++) {
            const int a = firsts[i], b = lasts[i];
            if (a > b) continue;
            for (int row = a / kTileHeight; row <= b / kTileHeight; row++) {
                const int y0 = higher(a - row * kTileHeight, 0), y1 = lower(b - row * kTileHeight, kTileHeight - 1);
                out[n++] = (uint32_t)((base + i) * frame.tiles_y + row) | (uint32_t)y0 << kTileBits |
                           (uint32_t)y1 << (kTileBits + kRowBits);
            }
        }
    }
    return n;
}

// What emission reads lane by lane.
struct Lanes {
    vf ellipse[8];  // in the order of Ellipse
    vf radius, depth;
    vi seen;
};

// Pieces, record and depth key of Gaussian g, which is lane i. head: the records' first twelve floats, as
// transpose_quads leaves them: row r of a quarter q is in vector r, lanes 4 q to 4 q + 3.
NEECO_INLINE void emit_gaussian(Frame& frame, const GaussianInputs& in, Chunk& chunk, int g, const Lanes& lanes, int i,
                                const vf (*head)[4], float* radii) {
    const float* channels = in.channels ? in.channels + (size_t)g * in.channel_count : nullptr;
    for (int ch = 0; ch < in.channel_count; ch++)
        if (!finite(channels[ch])) return;
    uint32_t* out = chunk.pieces.grow((size_t)chunk.piece_count + frame.tiles()) + chunk.piece_count;
    Ellipse ellipse;
    float* values = &ellipse.x;
    for (int k = 0; k < 8; k++) values[k] = lanes.ellipse[k][i];
    const uint32_t n = emit_pieces(frame, ellipse, out);
    if (n == 0) return;
    chunk.piece_count += n;
    frame.spans.data()[g].count = n;
    radii[g] = lanes.radius[i];
    float* record = frame.records.data() + (size_t)g * frame.record_stride;
    for (int k = 0; k < 3; k++) std::memcpy(record + 4 * k, (const float*)&head[k][i % 4] + i / 4 * 4, 16);
    for (int ch = 0; ch < in.channel_count; ch++) record[kRecordHead + 4 + ch] = channels[ch];
    for (int ch = 4 + in.channel_count; ch < frame.values; ch++) record[kRecordHead + ch] = 0;
    uint32_t key;
    const float depth = lanes.depth[i];
    std::memcpy(&key, &depth, 4);
    frame.visible_list.data()[(size_t)(g >> kChunkBits << kChunkBits) + chunk.visible++] = {key, (uint32_t)g};
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
    vf basis[16], color[3] = {all(0.5f), all(0.5f), all(0.5f)};
    if (in.sh_count > 1) sh_basis(in.sh_count, direction_lanes(c, in, p, index).local, basis);
    else basis[0] = all(kSh0);
    add_sh(in.sh_count, in.sh, index, basis, color);
    vf light = in.falloff ? light_lanes(in, p, index).factor : all(1.f);
    if (in.gains) light *= gather(in.gains, index, 1);
    seen &= finite(color[0]) & finite(color[1]) & finite(color[2]) & finite(light);
    const vf a = -0.5f * kLog2E * p.cov_yy * inverse_det, b = kLog2E * p.cov_xy * inverse_det,
             cc = -0.5f * kLog2E * p.cov_xx * inverse_det;
    const vf k0 = reach * p.det * inverse_xx, k1 = p.det * inverse_xx * inverse_xx;
    const Lanes lanes = {{x, y, half_width, half_height, p.cov_xy * inverse_xx, k0, k1, peak}, radius, p.z, seen};
    // Records by quads of their first twelve floats (a record has sixteen or more; channels overwrite the last two).
    vf head[3][4] = {{x, y, a, b}, {cc, log2_opacity}};
    for (int ch = 0; ch < 3; ch++) color[ch] = higher(color[ch], all(0.f)) * light;
    head[1][2] = color[0];
    head[1][3] = color[1];
    head[2][0] = color[2];
    head[2][1] = p.z;
    head[2][2] = head[2][3] = all(0.f);
    for (auto& quads : head) transpose_quads(quads);
    for (int i = 0; i < live; i++) {
        spans[index[i]] = {chunk.piece_count, 0};
        radii[index[i]] = 0;
        if (lanes.seen[i]) emit_gaussian(frame, in, chunk, index[i], lanes, i, head, radii);
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
        group_by_band(frame, number);
    };
    parallel_for((count + kChunk - 1) / kChunk, body);
}

}  // namespace NEECO_VARIANT
}  // namespace neeco
