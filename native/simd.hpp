// Vectors of NEECO_WIDTH floats through GCC/clang vector extensions. Everything lives in the variant's own namespace, so
// that no function compiled for one instruction set can be linked in place of another's.
#pragma once

#include <cstdint>
#include <cstring>

#if defined(__SSE2__)
#include <immintrin.h>
#elif defined(__wasm_simd128__)
#include <wasm_simd128.h>
#elif defined(__ARM_NEON)
#include <arm_neon.h>
#endif

#define NEECO_INLINE inline __attribute__((always_inline))

namespace neeco {
namespace NEECO_VARIANT {

constexpr int W = NEECO_WIDTH;
typedef float vf __attribute__((vector_size(W * 4)));
typedef int32_t vi __attribute__((vector_size(W * 4)));
typedef float vf_loose __attribute__((vector_size(W * 4), aligned(4), may_alias));
typedef float v4 __attribute__((vector_size(16)));
typedef float v4_loose __attribute__((vector_size(16), aligned(4), may_alias));
typedef float v8 __attribute__((vector_size(32)));
typedef float v8_loose __attribute__((vector_size(32), aligned(4), may_alias));

NEECO_INLINE vf load(const float* p) { return (vf) * (const vf_loose*)p; }
NEECO_INLINE void store(float* p, vf v) { *(vf_loose*)p = (vf_loose)v; }
NEECO_INLINE vf all(float x) { return x - (vf){}; }
NEECO_INLINE vi all(int32_t x) { return x - (vi){}; }
NEECO_INLINE vf select(vi mask, vf a, vf b) { return mask ? a : b; }
NEECO_INLINE vi select(vi mask, vi a, vi b) { return mask ? a : b; }
NEECO_INLINE int lower(int a, int b) { return a < b ? a : b; }
NEECO_INLINE int higher(int a, int b) { return a > b ? a : b; }
NEECO_INLINE float lower(float a, float b) { return a < b ? a : b; }
NEECO_INLINE float higher(float a, float b) { return a > b ? a : b; }
NEECO_INLINE vf iota() {
    vf r;
    for (int i = 0; i < W; i++) r[i] = (float)i;
    return r;
}
// Finite, decided on the bits: the compiler is told that floats are finite and would fold comparisons.
NEECO_INLINE vi finite(vf x) { return ((vi)x & 0x7f800000) != 0x7f800000; }
NEECO_INLINE bool finite(float x) {
    uint32_t bits;
    std::memcpy(&bits, &x, 4);
    return (bits & 0x7f800000u) != 0x7f800000u;
}
NEECO_INLINE vi to_int(vf x) { return __builtin_convertvector(x, vi); }
NEECO_INLINE vf to_float(vi x) { return __builtin_convertvector(x, vf); }

// lower and higher give b where the comparison is undecided, as minps does: GCC makes no minps of a < b ? a : b.
#if defined(__AVX512F__) && NEECO_WIDTH == 16
NEECO_INLINE bool any(vi m) { return _mm512_test_epi32_mask((__m512i)m, (__m512i)m) != 0; }
NEECO_INLINE vf root(vf x) { return (vf)_mm512_sqrt_ps((__m512)x); }
NEECO_INLINE vf lower(vf a, vf b) { return (vf)_mm512_min_ps((__m512)a, (__m512)b); }
NEECO_INLINE vf higher(vf a, vf b) { return (vf)_mm512_max_ps((__m512)a, (__m512)b); }
#elif defined(__AVX__) && NEECO_WIDTH == 8
NEECO_INLINE bool any(vi m) { return !_mm256_testz_si256((__m256i)m, (__m256i)m); }
NEECO_INLINE vf root(vf x) { return (vf)_mm256_sqrt_ps((__m256)x); }
NEECO_INLINE vf lower(vf a, vf b) { return (vf)_mm256_min_ps((__m256)a, (__m256)b); }
NEECO_INLINE vf higher(vf a, vf b) { return (vf)_mm256_max_ps((__m256)a, (__m256)b); }
#elif defined(__SSE2__)
NEECO_INLINE bool any(vi m) { return _mm_movemask_epi8((__m128i)m) != 0; }
NEECO_INLINE vf root(vf x) { return (vf)_mm_sqrt_ps((__m128)x); }
NEECO_INLINE vf lower(vf a, vf b) { return (vf)_mm_min_ps((__m128)a, (__m128)b); }
NEECO_INLINE vf higher(vf a, vf b) { return (vf)_mm_max_ps((__m128)a, (__m128)b); }
#elif defined(__wasm_simd128__)
NEECO_INLINE bool any(vi m) { return wasm_v128_any_true((v128_t)m); }
NEECO_INLINE vf root(vf x) { return (vf)wasm_f32x4_sqrt((v128_t)x); }
NEECO_INLINE vf lower(vf a, vf b) { return (vf)wasm_f32x4_pmin((v128_t)b, (v128_t)a); }
NEECO_INLINE vf higher(vf a, vf b) { return (vf)wasm_f32x4_pmax((v128_t)b, (v128_t)a); }
#else
NEECO_INLINE bool any(vi m) { return (m[0] | m[1] | m[2] | m[3]) != 0; }
NEECO_INLINE vf root(vf x) { return (vf)vsqrtq_f32((float32x4_t)x); }
NEECO_INLINE vf lower(vf a, vf b) { return a < b ? a : b; }
NEECO_INLINE vf higher(vf a, vf b) { return a > b ? a : b; }
#endif

// 1 / x for normal x, to the last digit but one: where the machine has an estimate, that made good by a step or two of Newton's
// (the coarse ones would leave errors that are all of one sign, and quotients are multiplied up).
NEECO_INLINE vf reciprocal(vf x) {
#if defined(__AVX512F__) && NEECO_WIDTH == 16
    const vf estimate = (vf)_mm512_rcp14_ps((__m512)x);
    return estimate * (2.f - x * estimate);
#elif defined(__AVX__) && NEECO_WIDTH == 8
    const vf estimate = (vf)_mm256_rcp_ps((__m256)x), error = 1.f - x * estimate;
    return estimate + estimate * (error + error * error);
#else
    return 1.f / x;
#endif
}

// 2^x for |x| < 126, relative error 1e-7 (degree 5, fitted on [-1/2, 1/2]); outside it is garbage, never a trap.
NEECO_INLINE vf exp2_fast(vf x) {
#if defined(__AVX512DQ__) && NEECO_WIDTH == 16
    const vf f = (vf)_mm512_reduce_ps((__m512)x, _MM_FROUND_TO_NEAREST_INT);
#else
    const float magic = 12582912.f;  // 1.5 * 2^23: adding it rounds to the nearest integer
    const vf shifted = x + magic;
    const vf f = x - (shifted - magic);
#endif
    // in pairs: shorter than one factor after the other
    const vf f2 = f * f, low = 6.9314696706e-1f * f + 1.0000000717f, middle = 5.5507132822e-2f * f + 2.4022119718e-1f,
             high = 1.3276470039e-3f * f + 9.6755416306e-3f;
    const vf p = (high * f2 + middle) * f2 + low;
#if defined(__AVX512DQ__) && NEECO_WIDTH == 16
    return (vf)_mm512_scalef_ps((__m512)p, (__m512)(x - f));
#else
    return (vf)((vi)p + (((vi)shifted) << 23));
#endif
}

// log2 of positive normal x: exponent plus the odd series of atanh on [sqrt(1/2), sqrt(2)].
NEECO_INLINE vf log2_fast(vf x) {
    const vi bits = (vi)x - 0x3f3504f3;  // bits of sqrt(1/2)
    const vi exponent = bits >> 23;
    const vf m = (vf)((bits & 0x7fffff) + 0x3f3504f3);
    const vf s = (m - 1.f) / (m + 1.f), s2 = s * s;
    vf p = s2 * 0.11111111f + 0.14285714f;
    p = p * s2 + 0.2f;
    p = p * s2 + 0.33333333f;
    return to_float(exponent) + s * (p * s2 + 1.f) * 2.8853900817779268f;
}

// r[lane] = base[stride * index[lane]]
NEECO_INLINE vf gather(const float* base, const int* index, int stride) {
    vf r;
    for (int i = 0; i < W; i++) r[i] = base[(size_t)stride * index[i]];
    return r;
}

// Four neighbouring floats of each of W rows, as four vectors: out[k][lane] = base[stride * index[lane] + k]. Built from
// whole loads and a 4 x 4 transposition in every quarter of a vector, where `gather` would insert lane by lane.
NEECO_INLINE v4 quad(const float* p) { return (v4) * (const v4_loose*)p; }
#if NEECO_WIDTH == 4
#define NEECO_ZIP(a, b, w, x, y, z) __builtin_shufflevector(a, b, w, x, y, z)
NEECO_INLINE vf rows_at(const float* base, size_t stride, const int* index, int i) { return quad(base + stride * index[i]); }
#elif NEECO_WIDTH == 8
#define NEECO_ZIP(a, b, w, x, y, z) \
    __builtin_shufflevector(a, b, NEECO_AT(8, w, 0), NEECO_AT(8, x, 0), NEECO_AT(8, y, 0), NEECO_AT(8, z, 0), NEECO_AT(8, w, 4), \
                            NEECO_AT(8, x, 4), NEECO_AT(8, y, 4), NEECO_AT(8, z, 4))
NEECO_INLINE vf rows_at(const float* base, size_t stride, const int* index, int i) {
    const v4 a = quad(base + stride * index[i]), b = quad(base + stride * index[i + 4]);
    return __builtin_shufflevector(a, b, 0, 1, 2, 3, 4, 5, 6, 7);
}
#else
#define NEECO_ZIP(a, b, w, x, y, z) \
    __builtin_shufflevector(a, b, NEECO_AT(16, w, 0), NEECO_AT(16, x, 0), NEECO_AT(16, y, 0), NEECO_AT(16, z, 0), NEECO_AT(16, w, 4), \
                            NEECO_AT(16, x, 4), NEECO_AT(16, y, 4), NEECO_AT(16, z, 4), NEECO_AT(16, w, 8), NEECO_AT(16, x, 8), \
                            NEECO_AT(16, y, 8), NEECO_AT(16, z, 8), NEECO_AT(16, w, 12), NEECO_AT(16, x, 12), \
                            NEECO_AT(16, y, 12), NEECO_AT(16, z, 12))
NEECO_INLINE vf rows_at(const float* base, size_t stride, const int* index, int i) {
    const v4 a = quad(base + stride * index[i]), b = quad(base + stride * index[i + 4]);
    const v4 c = quad(base + stride * index[i + 8]), d = quad(base + stride * index[i + 12]);
    const v8 low = __builtin_shufflevector(a, b, 0, 1, 2, 3, 4, 5, 6, 7), high = __builtin_shufflevector(c, d, 0, 1, 2, 3, 4, 5, 6, 7);
    return __builtin_shufflevector(low, high, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15);
}
#endif
// Entry i of a quarter of a (i < 4) or b (i - 4), in the quarter that starts at `offset` of vectors of `width`.
#define NEECO_AT(width, i, offset) ((i) < 4 ? (i) + (offset) : (width) + (i) - 4 + (offset))
NEECO_INLINE void transpose_quads(vf* v) {
    const vf a = NEECO_ZIP(v[0], v[1], 0, 4, 1, 5), b = NEECO_ZIP(v[2], v[3], 0, 4, 1, 5);
    const vf c = NEECO_ZIP(v[0], v[1], 2, 6, 3, 7), d = NEECO_ZIP(v[2], v[3], 2, 6, 3, 7);
    v[0] = NEECO_ZIP(a, b, 0, 1, 4, 5);
    v[1] = NEECO_ZIP(a, b, 2, 3, 6, 7);
    v[2] = NEECO_ZIP(c, d, 0, 1, 4, 5);
    v[3] = NEECO_ZIP(c, d, 2, 3, 6, 7);
}
NEECO_INLINE void load_quads(const float* base, size_t stride, const int* index, vf* out) {
    for (int i = 0; i < 4; i++) out[i] = rows_at(base, stride, index, i);
    transpose_quads(out);
}
NEECO_INLINE float sum(vf v) {
    float s = 0;
    for (int i = 0; i < W; i++) s += v[i];
    return s;
}

// out[i] = sum of the lanes of v[i], i < 8, by transposing additions.
#if NEECO_WIDTH == 4
NEECO_INLINE vf pair_sums(vf a, vf b) {
    return __builtin_shufflevector(a, b, 0, 4, 2, 6) + __builtin_shufflevector(a, b, 1, 5, 3, 7);
}
NEECO_INLINE vf four_sums(vf a, vf b, vf c, vf d) {
    const vf p = pair_sums(a, b), q = pair_sums(c, d);
    return __builtin_shufflevector(p, q, 0, 1, 4, 5) + __builtin_shufflevector(p, q, 2, 3, 6, 7);
}
NEECO_INLINE void store_sums(float* out, const vf* v) {
    store(out, four_sums(v[0], v[1], v[2], v[3]));
    store(out + 4, four_sums(v[4], v[5], v[6], v[7]));
}
#else
NEECO_INLINE v8 fold(vf v) {
#if NEECO_WIDTH == 16
    return __builtin_shufflevector(v, v, 0, 1, 2, 3, 4, 5, 6, 7) + __builtin_shufflevector(v, v, 8, 9, 10, 11, 12, 13, 14, 15);
#else
    return v;
#endif
}
NEECO_INLINE v8 add2(v8 a, v8 b) {
    return __builtin_shufflevector(a, b, 0, 8, 2, 10, 4, 12, 6, 14) + __builtin_shufflevector(a, b, 1, 9, 3, 11, 5, 13, 7, 15);
}
NEECO_INLINE v8 add4(v8 a, v8 b) {
    return __builtin_shufflevector(a, b, 0, 1, 8, 9, 4, 5, 12, 13) + __builtin_shufflevector(a, b, 2, 3, 10, 11, 6, 7, 14, 15);
}
NEECO_INLINE v8 add8(v8 a, v8 b) {
    return __builtin_shufflevector(a, b, 0, 1, 2, 3, 8, 9, 10, 11) + __builtin_shufflevector(a, b, 4, 5, 6, 7, 12, 13, 14, 15);
}
NEECO_INLINE void store_sums(float* out, const vf* v) {
    const v8 low = add4(add2(fold(v[0]), fold(v[1])), add2(fold(v[2]), fold(v[3])));
    const v8 high = add4(add2(fold(v[4]), fold(v[5])), add2(fold(v[6]), fold(v[7])));
    *(v8_loose*)out = (v8_loose)add8(low, high);
}
#endif

constexpr float kLog2E = 1.4426950408889634f;
constexpr float kLn2 = 0.6931471805599453f;
constexpr float kLog2Faintest = -7.994353436858858f;  // log2(1 / 255)
constexpr float kOpaque = 0.999f;
constexpr float kFull = 1e-4f;                        // transmittance at which a pixel is full
constexpr float kLowPass = 0.3f;                      // px^2

// A tile is one vector-friendly strip wide: a vector covers kRows rows of kStrip columns.
constexpr int kStrip = W < 8 ? W : 8;
constexpr int kRows = W / kStrip;
constexpr int kTileHeight = W == 16 ? 64 : 32;


// One row of a strip. Shorter than a vector where that holds two rows.
typedef float vs __attribute__((vector_size(kStrip * 4)));
typedef int32_t vsi __attribute__((vector_size(kStrip * 4)));
NEECO_INLINE vs strip_iota() {
    vs r;
    for (int i = 0; i < kStrip; i++) r[i] = (float)i;
    return r;
}
#if NEECO_WIDTH == 16
NEECO_INLINE vs root(vs x) { return (vs)_mm256_sqrt_ps((__m256)x); }
NEECO_INLINE vs lower(vs a, vs b) { return (vs)_mm256_min_ps((__m256)a, (__m256)b); }
NEECO_INLINE vs higher(vs a, vs b) { return (vs)_mm256_max_ps((__m256)a, (__m256)b); }
NEECO_INLINE vf both_rows(vs row) { return (vf)_mm512_broadcast_f32x8((__m256)row); }
#else
NEECO_INLINE vf both_rows(vs row) { return row; }
#endif

}  // namespace NEECO_VARIANT
}  // namespace neeco
