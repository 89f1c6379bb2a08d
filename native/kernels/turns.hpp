// Turns of points and quaternions about lines, W at a time, and their gradients; a pose's rotation as a quaternion.
#pragma once

#include "simd.hpp"

namespace neeco {
namespace NEECO_VARIANT {

// e^x. What is not finite stays so.
NEECO_INLINE vf exponential(vf x) {
    return select(finite(x), exp2_fast(lower(higher(x * kLog2E, all(-126.f)), all(126.f))), x);
}

// The same, of `count` numbers in a row; with `factors`, their products with it.
NEECO_INLINE void exponentials(const float* x, const float* factors, float* out, size_t count) {
    size_t i = 0;
    for (; i + W <= count; i += W) {
        const vf value = exponential(load(x + i));
        store(out + i, factors ? value * load(factors + i) : value);
    }
    vf rest = all(0.f);
    for (size_t k = i; k < count; k++) rest[k - i] = x[k];
    rest = exponential(rest);
    for (size_t k = i; k < count; k++) out[k] = factors ? rest[k - i] * factors[k] : rest[k - i];
}

// Sine and cosine, error 1e-7 for |x| up to some hundreds: minimax polynomials between -pi/4 and pi/4.
NEECO_INLINE void sine_cosine(vf x, vf* sine, vf* cosine) {
    const float magic = 12582912.f;  // see exp2_fast
    const vf shifted = x * 0.6366197723675814f + magic;
    const vi quarter = (vi)shifted;
    const vf n = shifted - magic;
    const vf r = (x - n * 1.5703125f) - n * 4.837512969970703125e-4f - n * 7.549789948768648e-8f;
    const vf z = r * r;
    const vf s = r + r * z * (-1.6666654611e-1f + z * (8.3321608736e-3f - z * 1.9515295891e-4f));
    const vf c = 1.f - 0.5f * z + z * z * (4.166664568298827e-2f + z * (-1.388731625493765e-3f + z * 2.443315711809948e-5f));
    const vi swapped = (quarter & 1) != 0, below = (quarter & 2) != 0, left = ((quarter + 1) & 2) != 0;
    const vf up = select(swapped, c, s), across = select(swapped, s, c);
    *sine = select(below, -up, up);
    *cosine = select(left, -across, across);
}

NEECO_INLINE vf dot3(const vf* a, const vf* b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }
NEECO_INLINE void cross3(const vf* a, const vf* b, vf* out) {
    out[0] = a[1] * b[2] - a[2] * b[1];
    out[1] = a[2] * b[0] - a[0] * b[2];
    out[2] = a[0] * b[1] - a[1] * b[0];
}
NEECO_INLINE void all3(const float* p, vf* out) {
    for (int k = 0; k < 3; k++) out[k] = all(p[k]);
}

// Hamilton products a b, conj(a) b and a conj(b).
NEECO_INLINE void quat_product(const vf* a, const vf* b, vf* out) {
    out[0] = a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3];
    out[1] = a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2];
    out[2] = a[0] * b[2] - a[1] * b[3] + a[2] * b[0] + a[3] * b[1];
    out[3] = a[0] * b[3] + a[1] * b[2] - a[2] * b[1] + a[3] * b[0];
}
NEECO_INLINE void undone_product(const vf* a, const vf* b, vf* out) {
    const vf inverse[4] = {a[0], -a[1], -a[2], -a[3]};
    quat_product(inverse, b, out);
}
NEECO_INLINE void product_undone(const vf* a, const vf* b, vf* out) {
    const vf inverse[4] = {b[0], -b[1], -b[2], -b[3]};
    quat_product(a, inverse, out);
}

// A turn by an angle about a line.
struct Turn {
    vf pivot[3], axis[3];
    vf quat[4], half_sine, sine, cosine;
};

NEECO_INLINE Turn turn_by(const float* pivot, const float* axis, vf angle) {
    Turn t;
    sine_cosine(0.5f * angle, &t.half_sine, &t.quat[0]);
    all3(pivot, t.pivot);
    all3(axis, t.axis);
    for (int k = 0; k < 3; k++) t.quat[1 + k] = t.half_sine * t.axis[k];
    t.sine = 2.f * t.half_sine * t.quat[0];
    t.cosine = 1.f - 2.f * t.half_sine * t.half_sine;
    return t;
}

// The point turned (Rodrigues), or with the other sine turned back.
NEECO_INLINE void turn_point(const Turn& t, vf sine, vf* point) {
    vf arm[3], across[3];
    for (int k = 0; k < 3; k++) arm[k] = point[k] - t.pivot[k];
    cross3(t.axis, arm, across);
    const vf along = dot3(t.axis, arm) * (1.f - t.cosine);
    for (int k = 0; k < 3; k++) point[k] = t.pivot[k] + t.cosine * arm[k] + sine * across[k] + along * t.axis[k];
}

NEECO_INLINE void turn_forward(const Turn& t, vf* point, vf* quat) {
    vf turned[4];
    turn_point(t, t.sine, point);
    quat_product(t.quat, quat, turned);
    for (int k = 0; k < 4; k++) quat[k] = turned[k];
}

// Point and quaternion back to before the turn, their gradients too; returns dL/d angle. to_pivot and to_axis get their lanes.
NEECO_INLINE vf turn_backward(const Turn& t, vf* point, vf* quat, vf* to_point, vf* to_quat, vf* to_pivot, vf* to_axis) {
    vf before[4], to_turn[4], arm[3], arm_across[3], back[3];
    turn_point(t, -t.sine, point);
    undone_product(t.quat, quat, before);
    for (int k = 0; k < 4; k++) quat[k] = before[k];
    product_undone(to_quat, quat, to_turn);
    undone_product(t.quat, to_quat, before);
    for (int k = 0; k < 4; k++) to_quat[k] = before[k];
    for (int k = 0; k < 3; k++) arm[k] = point[k] - t.pivot[k];
    cross3(arm, to_point, arm_across);
    cross3(to_point, t.axis, back);
    const vf along = dot3(t.axis, arm), to_along = dot3(t.axis, to_point), rest = 1.f - t.cosine;
    vf to_angle = t.sine * (along * to_along - dot3(arm, to_point)) + t.cosine * dot3(t.axis, arm_across);
    to_angle += 0.5f * (t.quat[0] * dot3(t.axis, to_turn + 1) - t.half_sine * to_turn[0]);
    for (int k = 0; k < 3; k++) {
        to_axis[k] = t.sine * arm_across[k] + rest * (to_along * arm[k] + along * to_point[k]) + t.half_sine * to_turn[1 + k];
        const vf moved = t.cosine * to_point[k] + t.sine * back[k] + rest * to_along * t.axis[k];
        to_pivot[k] = to_point[k] - moved;
        to_point[k] = moved;
    }
    return to_angle;
}

// The pose's rotation as a unit quaternion, w >= 0: the best conditioned row of a symmetric matrix (Shepperd 1978).
struct PoseTurn {
    float quat[4];
    int row;
    double length;  // of the row, with the sign that made w positive
};

// Which entries of the pose (rows of four) are summed, with which signs, in the matrix's entry (row, column).
template <class F>
NEECO_INLINE void each_term(int row, int column, F&& term) {
    const int i = row < column ? row : column, j = row < column ? column : row;
    if (i == j) {
        for (int k = 0; k < 3; k++) term(5 * k, i == 0 || i == k + 1 ? 1 : -1);
    } else if (i == 0) {
        const int k = j % 3, l = (j + 1) % 3;  // the other two axes
        term(4 * l + k, 1);
        term(4 * k + l, -1);
    } else {
        term(4 * (i - 1) + j - 1, 1);
        term(4 * (j - 1) + i - 1, 1);
    }
}

static PoseTurn turn_of_pose(const float* pose) {
    auto entry = [&](int row, int column) {
        double sum = row == column;
        each_term(row, column, [&](int place, int sign) { sum += sign * (double)pose[place]; });
        return sum;
    };
    PoseTurn turn{};
    for (int k = 1; k < 4; k++)
        if (entry(k, k) > entry(turn.row, turn.row)) turn.row = k;
    double square = 0;
    for (int k = 0; k < 4; k++) square += entry(turn.row, k) * entry(turn.row, k);
    turn.length = entry(turn.row, 0) < 0 ? -__builtin_sqrt(square) : __builtin_sqrt(square);
    for (int k = 0; k < 4; k++) turn.quat[k] = (float)(entry(turn.row, k) / turn.length);
    return turn;
}

// Adds to dL/d pose what comes by the quaternion.
static void turn_of_pose_backward(const PoseTurn& turn, const double* to_quat, double* to_pose) {
    double radial = 0;
    for (int k = 0; k < 4; k++) radial += to_quat[k] * turn.quat[k];
    for (int k = 0; k < 4; k++) {
        const double to_entry = (to_quat[k] - radial * turn.quat[k]) / turn.length;
        each_term(turn.row, k, [&](int place, int sign) { to_pose[place] += sign * to_entry; });
    }
}

}  // namespace NEECO_VARIANT
}  // namespace neeco
