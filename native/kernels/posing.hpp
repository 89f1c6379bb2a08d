// Posing of bodies of links that joints move (raster/articulated.py defines it), and its gradient: W Gaussians at a time.
//
// The gradient undoes one joint after the other instead of remembering what lay between them.
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
    vf greatest, inverse_sum; // of the link logits, for the softmax
    vf gate;                  // of its shares of moving links, what moves
};

NEECO_INLINE vf logit_of(const Body& b, const Resting& r, int link) { return gather(b.logits + link, r.index, b.logit_count); }

NEECO_INLINE vf share_of(const Body& b, const Resting& r, int link) {
    const vf logit = logit_of(b, r, link);
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
        for (int l = 1; l < b.links; l++) r.greatest = higher(logit_of(b, r, l), r.greatest);
        vf total = all(0.f);
        for (int l = 0; l < b.links; l++) total += exponential(logit_of(b, r, l) - r.greatest);
        r.inverse_sum = 1.f / total;
        r.gate = 1.f / (1.f + exponential((b.numbers[kGateStart] - along_shaft(b, r.point)) / b.numbers[kGateWidth]));
    }
    return r;
}

// The numbers of a joint.
NEECO_INLINE const float* joint_of(const Body& b, int joint) { return b.numbers + kBodyNumbers + joint * joint_numbers(b.links); }

// How far a Gaussian moves with every link but the first, and with all of them.
struct Shares {
    vf of[kMostLinks], moving;  // of[0] is not set
};

NEECO_INLINE Shares shares_of(const Body& b, const Resting& r) {
    Shares s;
    s.moving = all(0.f);
    for (int l = 1; l < b.links; l++) {
        s.of[l] = share_of(b, r, l) * r.gate;
        s.moving += s.of[l];
    }
    return s;
}

// By how much a joint turns or slides a Gaussian.
NEECO_INLINE vf amount_of(const Body& b, const Shares& shares, int joint) {
    const float* values = joint_of(b, joint) + kValues;
    vf amount = all(0.f);
    for (int l = b.links - 1; l > 0; l--) amount += shares.of[l] * values[l - 1];
    return amount;
}

NEECO_INLINE bool slides(const Body& b, int joint) { return b.slides >> joint & 1; }

NEECO_INLINE Turn joint_turn(const Body& b, int joint, vf angle) {
    const float* numbers = joint_of(b, joint);
    return turn_by(numbers + kOrigin, numbers + kAxis, angle);
}

NEECO_INLINE void slide_point(const Body& b, int joint, vf amount, vf* point) {
    const float* axis = joint_of(b, joint) + kAxis;
    for (int k = 0; k < 3; k++) point[k] += amount * axis[k];
}

NEECO_INLINE Turn spin_turn(const Body& b, const Resting& r) {
    const vi before = along_shaft(b, r.point) < b.numbers[kSpinEnd];
    return turn_by(b.numbers + kShaftOrigin, b.numbers + kShaftDirection, select(before, all(b.roll), all(0.f)));
}

// The longest that each Gaussian may be, by how much of it moves.
NEECO_INLINE vf longest_of(const Body& b, vf moving) { return b.numbers[kLongest] / higher(moving, all(1e-6f)); }

NEECO_INLINE void store_rows(float* base, int columns, const Resting& r, const vf* values) {
    for (int i = 0; i < r.live; i++)
        for (int k = 0; k < columns; k++) base[(size_t)columns * r.index[i] + k] = values[k][i];
}

NEECO_INLINE void pose_lanes(const Body& b, const PoseTurn& posed, const PosedRows& out, int row) {
    Resting r = rest_lanes(b, row);
    vf frame[4] = {all(1.f), all(0.f), all(0.f), all(0.f)}, turned[4];
    auto apply = [&](const Turn& t) {
        turn_forward(t, r.point, r.quat);
        quat_product(t.quat, frame, turned);
        for (int k = 0; k < 4; k++) frame[k] = turned[k];
    };
    const Shares shares = b.joints ? shares_of(b, r) : Shares{};
    if (b.roll != 0) apply(spin_turn(b, r));
    for (int joint = 0; joint < b.joints; joint++) {
        const vf amount = amount_of(b, shares, joint);
        if (slides(b, joint)) slide_point(b, joint, amount, r.point);
        else apply(joint_turn(b, joint, amount));
    }
    vf world[3], turn[4], scales[3];
    const float* pose = b.numbers + kPose;
    for (int k = 0; k < 3; k++)
        world[k] = pose[4 * k] * r.point[0] + pose[4 * k + 1] * r.point[1] + pose[4 * k + 2] * r.point[2] + pose[4 * k + 3];
    for (int k = 0; k < 4; k++) turn[k] = all(posed.quat[k]);
    load_triples(b.log_scales, b.total, r.index, scales);
    for (int k = 0; k < 3; k++) {
        scales[k] = exponential(scales[k]);
        if (b.joints) scales[k] = lower(longest_of(b, shares.moving), scales[k]);
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
    const Shares shares = b.joints ? shares_of(b, r) : Shares{};
    const Turn spin = b.roll != 0 ? spin_turn(b, r) : Turn{};
    if (b.roll != 0) turn_forward(spin, r.point, r.quat);
    for (int joint = 0; joint < b.joints; joint++) {
        const vf amount = amount_of(b, shares, joint);
        if (slides(b, joint)) slide_point(b, joint, amount, r.point);
        else turn_forward(joint_turn(b, joint, amount), r.point, r.quat);
    }
    vf to_world[3], to_posed[4], scales[3], to_scales[3];
    load_triples(from.means, b.total, r.index, to_world);
    load_quads(from.quats, 4, r.index, to_posed);
    load_triples(b.log_scales, b.total, r.index, scales);
    load_triples(from.scales, b.total, r.index, to_scales);
    for (int k = 0; k < 3; k++) {
        const vf scale = exponential(scales[k]);
        to_scales[k] *= scale;
        if (b.joints) to_scales[k] = select(scale < longest_of(b, shares.moving), to_scales[k], all(0.f));
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

    vf to_origin[3], to_axis[3], to_share[kMostLinks], along_shares = all(0.f);
    for (int l = 0; l < b.links; l++) to_share[l] = all(0.f);
    for (int joint = b.joints - 1; joint >= 0; joint--) {
        const float* numbers = joint_of(b, joint);
        double* own = sums + (numbers - b.numbers);
        const vf amount = amount_of(b, shares, joint);
        vf to_amount;
        if (slides(b, joint)) {
            slide_point(b, joint, -amount, r.point);
            vf axis[3];
            all3(numbers + kAxis, axis);
            to_amount = dot3(axis, to_point);
            for (int k = 0; k < 3; k++) to_axis[k] = amount * to_point[k];
        } else {
            to_amount = turn_backward(joint_turn(b, joint, amount), r.point, r.quat, to_point, to_quat, to_origin, to_axis);
            add_sums(own + kOrigin, r, to_origin, 3);
        }
        add_sums(own + kAxis, r, to_axis, 3);
        for (int l = 1; l < b.links; l++) {
            const vf to_value = to_amount * shares.of[l];
            add_sums(own + kValues + l - 1, r, &to_value, 1);
            to_share[l] += to_amount * numbers[kValues + l - 1] * r.gate;
        }
        along_shares += to_amount * amount;
    }
    for (int l = 0; l < b.links && b.joints; l++) {
        const vf to_logit = share_of(b, r, l) * (to_share[l] - along_shares);
        for (int i = 0; i < r.live; i++) to.logits[(size_t)b.logit_count * r.index[i] + l] = to_logit[i];
    }
    if (b.roll != 0) {
        turn_backward(spin, r.point, r.quat, to_point, to_quat, to_origin, to_axis);
        add_sums(sums + kShaftOrigin, r, to_origin, 3);
        add_sums(sums + kShaftDirection, r, to_axis, 3);
    }
    const vf radial = resting_quat[0] * to_quat[0] + resting_quat[1] * to_quat[1] + resting_quat[2] * to_quat[2] + resting_quat[3] * to_quat[3];
    for (int k = 0; k < 4; k++) to_quat[k] = (to_quat[k] - radial * resting_quat[k]) / resting_norm;
    store_rows(to.means, 3, r, to_point);
    store_rows(to.quats, 4, r, to_quat);
}

static void pose_backward(const Body& b, const PosedRows& from, const PosedRows& to, Buffer<double>& partial, float* to_numbers) {
    const int end = b.first + b.count, chunks = (b.count + kPosingChunk - 1) / kPosingChunk;
    const size_t numbers = kBodyNumbers + (size_t)b.joints * joint_numbers(b.links);
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
