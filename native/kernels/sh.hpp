// Real spherical harmonics up to degree 3, with the constants and signs of 3D Gaussian Splatting (Kerbl et al. 2023).
#pragma once

#include "simd.hpp"

namespace neeco {
namespace NEECO_VARIANT {

constexpr float kSh0 = 0.28209479177387814f, kSh1 = 0.4886025119029199f;
constexpr float kSh2 = 1.0925484305920792f, kSh20 = 0.31539156525252005f, kSh22 = 0.5462742152960396f;
constexpr float kSh33 = 0.5900435899266435f, kSh32 = 2.890611442640554f, kSh31 = 0.4570457994644658f;
constexpr float kSh30 = 0.3731763325901154f, kSh3z = 1.445305721320277f;

NEECO_INLINE void sh_basis(int count, const vf* d, vf* b) {
    const vf x = d[0], y = d[1], z = d[2];
    b[0] = all(kSh0);
    if (count == 1) return;
    b[1] = -kSh1 * y;
    b[2] = kSh1 * z;
    b[3] = -kSh1 * x;
    if (count == 4) return;
    const vf xx = x * x, yy = y * y, zz = z * z;
    b[4] = kSh2 * x * y;
    b[5] = -kSh2 * y * z;
    b[6] = kSh20 * (2.f * zz - xx - yy);
    b[7] = -kSh2 * x * z;
    b[8] = kSh22 * (xx - yy);
    if (count == 9) return;
    b[9] = -kSh33 * y * (3.f * xx - yy);
    b[10] = kSh32 * x * y * z;
    b[11] = -kSh31 * y * (4.f * zz - xx - yy);
    b[12] = kSh30 * z * (2.f * zz - 3.f * xx - 3.f * yy);
    b[13] = -kSh31 * x * (4.f * zz - xx - yy);
    b[14] = kSh3z * z * (xx - yy);
    b[15] = -kSh33 * x * (xx - 3.f * yy);
}

// visit(j, coefficients): every coefficient j (of 3 * Count: r, g, b of the first, r, g, b of the second, ...) of W rows.
template <int Count, class F>
NEECO_INLINE void sh_coefficients(const float* sh, const int* index, F&& visit) {
    constexpr int length = 3 * Count;
    if (length < 4) {
        for (int j = 0; j < length; j++) visit(j, gather(sh + j, index, length));
        return;
    }
#pragma GCC unroll 12
    for (int done = 0; done < length; done += 4) {
        const int at = done + 4 <= length ? done : length - 4;  // never past a row's end
        vf quads[4];
        load_quads(sh + at, length, index, quads);
#pragma GCC unroll 4
        for (int k = done - at; k < 4; k++) visit(at + k, quads[k]);
    }
}

// color[c] += sum over k of basis[k] * sh[row][k][c].
template <int Count>
NEECO_INLINE void add_sh(const float* sh, const int* index, const vf* basis, vf* color) {
    sh_coefficients<Count>(sh, index, [&](int j, vf coefficient) __attribute__((always_inline)) { color[j % 3] += basis[j / 3] * coefficient; });
}

// w[k] = sum over c of to_color[c] * sh[row][k][c].
template <int Count>
NEECO_INLINE void sh_products(const float* sh, const int* index, const vf* to_color, vf* w) {
    for (int k = 0; k < Count; k++) w[k] = all(0.f);
    sh_coefficients<Count>(sh, index, [&](int j, vf coefficient) __attribute__((always_inline)) { w[j / 3] += to_color[j % 3] * coefficient; });
}

// The same for a number of coefficients known only at run time.
NEECO_INLINE void add_sh(int count, const float* sh, const int* index, const vf* basis, vf* color) {
    switch (count) {
        case 1: return add_sh<1>(sh, index, basis, color);
        case 4: return add_sh<4>(sh, index, basis, color);
        case 9: return add_sh<9>(sh, index, basis, color);
        default: return add_sh<16>(sh, index, basis, color);
    }
}
NEECO_INLINE void sh_products(int count, const float* sh, const int* index, const vf* to_color, vf* w) {
    switch (count) {
        case 4: return sh_products<4>(sh, index, to_color, w);
        case 9: return sh_products<9>(sh, index, to_color, w);
        default: return sh_products<16>(sh, index, to_color, w);
    }
}

// g = sum over k of w[k] * gradient of basis k at d.
NEECO_INLINE void sh_direction_gradient(int count, const vf* d, const vf* w, vf* g) {
    const vf x = d[0], y = d[1], z = d[2];
    vf gx = -kSh1 * w[3], gy = -kSh1 * w[1], gz = kSh1 * w[2];
    if (count > 4) {
        gx += kSh2 * (w[4] * y - w[7] * z) - 2.f * kSh20 * w[6] * x + 2.f * kSh22 * w[8] * x;
        gy += kSh2 * (w[4] * x - w[5] * z) - 2.f * kSh20 * w[6] * y - 2.f * kSh22 * w[8] * y;
        gz += -kSh2 * (w[5] * y + w[7] * x) + 4.f * kSh20 * w[6] * z;
    }
    if (count > 9) {
        const vf xx = x * x, yy = y * y, zz = z * z, xy = x * y, yz = y * z, xz = x * z;
        gx += -6.f * kSh33 * w[9] * xy + kSh32 * w[10] * yz + 2.f * kSh31 * w[11] * xy - 6.f * kSh30 * w[12] * xz -
              kSh31 * w[13] * (4.f * zz - 3.f * xx - yy) + 2.f * kSh3z * w[14] * xz - 3.f * kSh33 * w[15] * (xx - yy);
        gy += -3.f * kSh33 * w[9] * (xx - yy) + kSh32 * w[10] * xz - kSh31 * w[11] * (4.f * zz - xx - 3.f * yy) -
              6.f * kSh30 * w[12] * yz + 2.f * kSh31 * w[13] * xy - 2.f * kSh3z * w[14] * yz + 6.f * kSh33 * w[15] * xy;
        gz += kSh32 * w[10] * xy - 8.f * kSh31 * w[11] * yz + kSh30 * w[12] * (6.f * zz - 3.f * xx - 3.f * yy) -
              8.f * kSh31 * w[13] * xz + kSh3z * w[14] * (xx - yy);
    }
    g[0] = gx;
    g[1] = gy;
    g[2] = gz;
}

}  // namespace NEECO_VARIANT
}  // namespace neeco
