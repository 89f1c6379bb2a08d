// By how much Gaussians are unobserved from a camera (scene/visibility.py defines it): W of them at a time.
#pragma once

#include "geometry.hpp"
#include "kernels.hpp"
#include "parallel.hpp"

namespace neeco {
namespace NEECO_VARIANT {

static void unobserved(const ViewInputs& in, float* to) {
    parallel_for((in.count + kChunk - 1) / kChunk, [&](int chunk) {
        const int end = lower(in.count, (chunk + 1) * kChunk);
        for (int row = chunk * kChunk; row < end; row += W) {
            int index[W];
            for (int i = 0; i < W; i++) index[i] = lower(row + i, end - 1);
            vf mean[3], outward[3], seen[kViewDirections];
            load_triples(in.means, in.count, index, mean);
            for (int k = 0; k < 3; k++) outward[k] = in.centre[k] - mean[k];
            const vf norm = root(outward[0] * outward[0] + outward[1] * outward[1] + outward[2] * outward[2]);
            for (int k = 0; k < 3; k++) outward[k] = outward[k] / higher(norm, all(1e-12f));
            if (in.frames) {  // into the frame of the harmonics
                vf q[4], r[9], turned[3];
                load_quads(in.frames, 4, index, q);
                rotation_matrix(q, r);
                for (int k = 0; k < 3; k++) turned[k] = r[k] * outward[0] + r[3 + k] * outward[1] + r[6 + k] * outward[2];
                for (int k = 0; k < 3; k++) outward[k] = turned[k];
            }
            for (int k = 0; k < kViewDirections; k += 4) load_quads(in.visibility + k, kViewDirections, index, seen + k);
            vf share = all(0.f), total = all(0.f);
            for (int k = 0; k < kViewDirections; k++) {
                const float* d = in.directions + 3 * k;
                const vf cosine = higher(d[0] * outward[0] + d[1] * outward[1] + d[2] * outward[2], all(0.f));
                const vf weight = (cosine * cosine) * (cosine * cosine);
                share += seen[k] * weight;
                total += weight;
            }
            float found[W];
            store(found, in.half / (share / total + in.half));
            for (int i = 0; i < lower(W, end - row); i++) to[row + i] = found[i];
        }
    });
}

}  // namespace NEECO_VARIANT
}  // namespace neeco
