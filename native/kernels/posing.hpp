// Posing of bodies whose parts turn about hinges (raster/posing.py defines it), and its gradient: W Gaussians at a time.
//
// The gradient undoes one turn after the other instead of remembering what lay between them.
#pragma once

#include "geometry.hpp"
#include "kernels.hpp"
#include "parallel.hpp"
#include "turns.hpp"

namespace neeco {
namespace NEECO_VARIANT {

constexpr int kPosingChunk = 512;  // Gaussians with sums of their own, whatever the number of threads

// W Gaussians of a body before any turn.
struct Resting {
    int index[W], live;
    vi lanes;                 // which are of the body: at its end some are not
    vf point[3], norm, quat[4];
    vf greatest, inverse_sum; // of the part logits, for the softmax
    vf gate;                  // share of its turning part that turns
};

NEECO_INLINE vf logit_of(const Body& b, const Resting& r, int part) { return gather(b.logits + part, r.index, b.logit_count); }

NEECO_INLINE vf share_of(const Body& b, const Resting& r, int part) {
    const vf logit = logit_of(b, r, part);
    return select(finite(logit), exponential(logit - r.greatest) * r.inverse_sum, logit);
}

NEECO_INLINE vf along_shaft(const Body& b, const vf* point) {
    vf origin[3], direction[3], arm[3];
    all3(b.numbers + kShaftOrigin, origin);
    all3(b.numbers + kShaftDirection, direction);
    for (int k = 0; k < 3; k++) arm[k] = point[k] - origin[k];
    return dot3(arm, direction);
}

NEECO_INLINE Resting rest_lanes(const Body& b, int row) {
    Resting r;
    r.live = lower(W, b.first + b.count - row);
    for (int i = 0; i < W; i++) r.index[i] = row + lower(i, r.live - 1);
    r.lanes = iota() < (float)r.live;
    load_triples(b.means, b.total, r.index, r.point);
    load_quads(b.quats, 4, r.index, r.quat);
    r.norm = root(r.quat[0] * r.quat[0] + r.quat[1] * r.quat[1] + r.quat[2] * r.quat[2] + r.quat[3] * r.quat[3]);
    r.norm = select(r.norm < 1e-12f, all(1e-12f), r.norm);
    for (int k = 0; k < 4; k++) r.quat[k] = r.quat[k] / r.norm;
    if (b.joints) {
        r.greatest = logit_of(b, r, 0);
        for (int p = 1; p <= 2 * b.joints; p++) r.greatest = higher(logit_of(b, r, p), r.greatest);
        vf total = all(0.f);
        for (int p = 0; p <= 2 * b.joints; p++) total += exponential(logit_of(b, r, p) - r.greatest);
        r.inverse_sum = 1.f / total;
        r.gate = 1.f / (1.f + exponential((b.numbers[kGateStart] - along_shaft(b, r.point)) / b.numbers[kGateWidth]));
    }
    return r;
}

// The two parts' shares of turning, and the angle they come to.
struct Pull {
    vf first, second, angle;
};

NEECO_INLINE Pull pull_of(const Body& b, const Resting& r, int joint) {
    const float* angles = b.numbers + kBodyNumbers + joint * kHingeNumbers + kAngles;
    Pull p;
    p.first = share_of(b, r, 1 + 2 * joint) * r.gate;
    p.second = share_of(b, r, 2 + 2 * joint) * r.gate;
    p.angle = p.first * angles[0] + p.second * angles[1];
    return p;
}

NEECO_INLINE Turn hinge_turn(const Body& b, int joint, vf angle) {
    const float* hinge = b.numbers + kBodyNumbers + joint * kHingeNumbers;
    return turn_by(hinge + kPivot, hinge + kAxis, angle);
}

NEECO_INLINE Turn spin_turn(const Body& b, const Resting& r) {
    const vi before = along_shaft(b, r.point) < b.numbers[kSpinEnd];
    return turn_by(b.numbers + kShaftOrigin, b.numbers + kShaftDirection, select(before, all(b.roll), all(0.f)));
}

// The longest that each Gaussian may be, by how much of it turns.
NEECO_INLINE vf longest_of(const Body& b, vf turning) { return b.numbers[kLongest] / higher(turning, all(1e-6f)); }

NEECO_INLINE void store_rows(float* base, int columns, const Resting& r, const vf* values) {
    for (int i = 0; i < r.live; i++)
        for (int k = 0; k < columns; k++) base[(size_t)columns * r.index[i] + k] = values[k][i];
}

NEECO_INLINE void pose_lanes(const Body& b, const PoseTurn& posed, const PosedRows& out, int row) {
    Resting r = rest_lanes(b, row);
    vf frame[4] = {all(1.f), all(0.f), all(0.f), all(0.f)}, turning = all(0.f), turned[4];
    auto apply = [&](const Turn& t) {
        turn_forward(t, r.point, r.quat);
        quat_product(t.quat, frame, turned);
        for (int k = 0; k < 4; k++) frame[k] = turned[k];
    };
    if (b.roll != 0) apply(spin_turn(b, r));
    for (int joint = 0; joint < b.joints; joint++) {
        const Pull pull = pull_of(b, r, joint);
        turning += pull.first + pull.second;
        apply(hinge_turn(b, joint, pull.angle));
    }
    vf world[3], turn[4], scales[3];
    const float* pose = b.numbers + kPose;
    for (int k = 0; k < 3; k++)
        world[k] = pose[4 * k] * r.point[0] + pose[4 * k + 1] * r.point[1] + pose[4 * k + 2] * r.point[2] + pose[4 * k + 3];
    for (int k = 0; k < 4; k++) turn[k] = all(posed.quat[k]);
    load_triples(b.log_scales, b.total, r.index, scales);
    for (int k = 0; k < 3; k++) {
        scales[k] = exponential(scales[k]);
        if (b.joints) scales[k] = lower(longest_of(b, turning), scales[k]);
    }
    store_rows(out.means, 3, r, world);
    store_rows(out.scales, 3, r, scales);
    quat_product(turn, r.quat, turned);
    store_rows(out.quats, 4, r, turned);
    quat_product(turn, frame, turned);
    store_rows(out.frames, 4, r, turned);
}

static void pose(const Body& b, const PosedRows& out) {
    const int end = b.first + b.count;
    const PoseTurn posed = b.numbers ? turn_of_pose(b.numbers + kPose) : PoseTurn{};
    auto chunk = [&](int number) {
        const int from = b.first + number * kPosingChunk, to = lower(from + kPosingChunk, end);
        if (b.numbers) {
            for (int row = from; row < to; row += W) pose_lanes(b, posed, out, row);
            return;
        }
        std::memcpy(out.means + 3 * (size_t)from, b.means + 3 * (size_t)from, (size_t)(to - from) * 12);
        std::memcpy(out.quats + 4 * (size_t)from, b.quats + 4 * (size_t)from, (size_t)(to - from) * 16);
        for (int row = from; row < to; row++)
            for (int k = 0; k < 4; k++) out.frames[4 * (size_t)row + k] = k == 0;
        exponentials(b.log_scales + 3 * (size_t)from, nullptr, out.scales + 3 * (size_t)from, 3 * (size_t)(to - from));
    };
    parallel_for((b.count + kPosingChunk - 1) / kPosingChunk, chunk);
}

// Adds the lanes that are of the body, in double.
NEECO_INLINE void add_sums(double* to, const Resting& r, const vf* values, int count) {
    for (int k = 0; k < count; k++) to[k] += sum(select(r.lanes, values[k], all(0.f)));
}

NEECO_INLINE void pose_lanes_backward(const Body& b, const PoseTurn& posed, const PosedRows& from, const PosedRows& to, int row, double* sums) {
    Resting r = rest_lanes(b, row);
    const vf resting_norm = r.norm, resting_quat[4] = {r.quat[0], r.quat[1], r.quat[2], r.quat[3]};
    const Turn spin = b.roll != 0 ? spin_turn(b, r) : Turn{};
    if (b.roll != 0) turn_forward(spin, r.point, r.quat);
    vf turning = all(0.f);
    for (int joint = 0; joint < b.joints; joint++) {
        const Pull pull = pull_of(b, r, joint);
        turning += pull.first + pull.second;
        turn_forward(hinge_turn(b, joint, pull.angle), r.point, r.quat);
    }
    vf to_world[3], to_posed[4], scales[3], to_scales[3];
    load_triples(from.means, b.total, r.index, to_world);
    load_quads(from.quats, 4, r.index, to_posed);
    load_triples(b.log_scales, b.total, r.index, scales);
    load_triples(from.scales, b.total, r.index, to_scales);
    for (int k = 0; k < 3; k++) {
        const vf scale = exponential(scales[k]);
        to_scales[k] *= scale;
        if (b.joints) to_scales[k] = select(scale < longest_of(b, turning), to_scales[k], all(0.f));
    }
    store_rows(to.scales, 3, r, to_scales);

    const float* pose = b.numbers + kPose;
    vf turn[4], to_turn[4], to_pose[12], to_point[3], to_quat[4];
    for (int k = 0; k < 3; k++) {
        for (int l = 0; l < 3; l++) to_pose[4 * k + l] = to_world[k] * r.point[l];
        to_pose[4 * k + 3] = to_world[k];
        to_point[k] = pose[k] * to_world[0] + pose[4 + k] * to_world[1] + pose[8 + k] * to_world[2];
    }
    for (int k = 0; k < 4; k++) turn[k] = all(posed.quat[k]);
    product_undone(to_posed, r.quat, to_turn);
    undone_product(turn, to_posed, to_quat);
    add_sums(sums + kPose, r, to_pose, 12);
    add_sums(sums + kSpinEnd, r, to_turn, 4);  // no gradient is wanted of what stands there

    vf to_pivot[3], to_axis[3], along_shares = all(0.f);
    for (int joint = b.joints - 1; joint >= 0; joint--) {
        const float* angles = b.numbers + kBodyNumbers + joint * kHingeNumbers + kAngles;
        double* hinge_sums = sums + kBodyNumbers + joint * kHingeNumbers;
        const Pull pull = pull_of(b, r, joint);
        const vf to_angle = turn_backward(hinge_turn(b, joint, pull.angle), r.point, r.quat, to_point, to_quat, to_pivot, to_axis);
        const vf to_angles[2] = {to_angle * pull.first, to_angle * pull.second};
        add_sums(hinge_sums + kPivot, r, to_pivot, 3);
        add_sums(hinge_sums + kAxis, r, to_axis, 3);
        add_sums(hinge_sums + kAngles, r, to_angles, 2);
        along_shares += to_angle * pull.angle;
        for (int side = 0; side < 2; side++)  // dL/d share; the softmax's own part follows when all of them are known
            for (int i = 0; i < r.live; i++)
                to.logits[(size_t)b.logit_count * r.index[i] + 1 + 2 * joint + side] = to_angle[i] * angles[side] * r.gate[i];
    }
    for (int part = 0; part <= 2 * b.joints && b.joints; part++) {
        const vf share = share_of(b, r, part);
        for (int i = 0; i < r.live; i++) {
            float* logit = to.logits + (size_t)b.logit_count * r.index[i] + part;
            *logit = share[i] * ((part ? *logit : 0.f) - along_shares[i]);
        }
    }
    if (b.roll != 0) {
        turn_backward(spin, r.point, r.quat, to_point, to_quat, to_pivot, to_axis);
        add_sums(sums + kShaftOrigin, r, to_pivot, 3);
        add_sums(sums + kShaftDirection, r, to_axis, 3);
    }
    const vf radial = resting_quat[0] * to_quat[0] + resting_quat[1] * to_quat[1] + resting_quat[2] * to_quat[2] + resting_quat[3] * to_quat[3];
    for (int k = 0; k < 4; k++) to_quat[k] = (to_quat[k] - radial * resting_quat[k]) / resting_norm;
    store_rows(to.means, 3, r, to_point);
    store_rows(to.quats, 4, r, to_quat);
}

static void pose_backward(const Body& b, const PosedRows& from, const PosedRows& to, Buffer<double>& partial, float* to_numbers) {
    const int end = b.first + b.count, chunks = (b.count + kPosingChunk - 1) / kPosingChunk;
    const size_t numbers = kBodyNumbers + (size_t)b.joints * kHingeNumbers;
    double* sums = b.numbers ? partial.reserve((chunks + 1) * numbers) : nullptr;
    const PoseTurn posed = b.numbers ? turn_of_pose(b.numbers + kPose) : PoseTurn{};
    auto chunk = [&](int number) {
        const int first = b.first + number * kPosingChunk, last = lower(first + kPosingChunk, end);
        if (b.numbers) {
            double* own = sums + number * numbers;
            std::memset(own, 0, numbers * sizeof(double));
            for (int row = first; row < last; row += W) pose_lanes_backward(b, posed, from, to, row, own);
            return;
        }
        std::memcpy(to.means + 3 * (size_t)first, from.means + 3 * (size_t)first, (size_t)(last - first) * 12);
        std::memcpy(to.quats + 4 * (size_t)first, from.quats + 4 * (size_t)first, (size_t)(last - first) * 16);
        exponentials(b.log_scales + 3 * (size_t)first, from.scales + 3 * (size_t)first, to.scales + 3 * (size_t)first, 3 * (size_t)(last - first));
    };
    parallel_for(chunks, chunk);
    if (!b.numbers) return;
    double* total = sums + chunks * numbers;
    for (size_t k = 0; k < numbers; k++) {
        total[k] = 0;
        for (int c = 0; c < chunks; c++) total[k] += sums[c * numbers + k];
    }
    turn_of_pose_backward(posed, total + kSpinEnd, total + kPose);
    for (int k = 0; k < 4; k++) total[kSpinEnd + k] = 0;
    for (size_t k = 0; k < numbers; k++) to_numbers[k] = (float)total[k];
}

}  // namespace NEECO_VARIANT
}  // namespace neeco
