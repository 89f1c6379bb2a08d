// (1 - w) L1 + w (1 - SSIM) and its gradient. SSIM (Wang et al. 2004) as 3DGS computes it: 11 x 11 Gaussian window, sigma 1.5,
// zero padding, each colour apart.
//
// Images stay interleaved: a row is 3 * width floats and a step of one pixel is three of them. Work is cut into bands of
// rows of fixed height, each with sums of its own, so the number of threads does not show in the result.
#pragma once

#include "kernels.hpp"
#include "parallel.hpp"
#include "simd.hpp"

namespace neeco {
namespace NEECO_VARIANT {

constexpr int kReach = 5, kBand = 16, kBandRows = kBand + 2 * kReach, kPad = 16;
// exp(-k^2 / (2 * 1.5^2)), normalised to sum 1 over k = -5..5
constexpr float kWindow[kReach + 1] = {0.26601172486179436f, 0.2130055377112537f,    0.10936068950970002f,
                                       0.03600077212843083f, 0.007598758135239185f, 0.00102838008447911f};
constexpr float kC1 = 1e-4f, kC2 = 9e-4f;

NEECO_INLINE size_t padded_row(int width) { return ((size_t)width * 3 + kPad - 1) / kPad * kPad + 2 * kPad; }

// Memory of this thread, kept between calls.
struct Scratch {
    float* data = nullptr;
    size_t size = 0;
    ~Scratch() { std::free(data); }
};

static float* scratch(size_t size) {
    static thread_local Scratch s;
    if (s.size < size) {
        std::free(s.data);
        s.data = (float*)std::calloc(size + kPad, sizeof(float));
        s.size = s.data ? size : 0;
    }
    return s.data;
}

// Blurs one row; `in` must have kPad readable floats on both sides, zero beyond the row.
NEECO_INLINE void blur_row(const float* in, float* out, int length) {
    for (int i = 0; i < length; i += W) {
        vf sum = kWindow[0] * load(in + i);
        for (int k = 1; k <= kReach; k++) sum += kWindow[k] * (load(in + i - 3 * k) + load(in + i + 3 * k));
        store(out + i, sum);
    }
}

// Blurs down a column of W values; `row` is the band's row + kReach.
NEECO_INLINE vf blur_column(const float* field, size_t stride, int row, int i) {
    const float* centre = field + stride * row + i;
    vf sum = kWindow[0] * load(centre);
    for (int k = 1; k <= kReach; k++) sum += kWindow[k] * (load(centre - stride * k) + load(centre + stride * k));
    return sum;
}

// out = values * mask, with the mask's one number per pixel.
NEECO_INLINE void masked_row(const float* values, const float* mask, int width, float* out) {
    if (!mask) {
        std::memcpy(out, values, (size_t)width * 12);
        return;
    }
    for (int x = 0; x < width; x++)
        for (int c = 0; c < 3; c++) out[3 * x + c] = values[3 * x + c] * mask[x];
}

NEECO_INLINE void clear_ends(float* row, int length, size_t stride) {
    std::memset(row - kPad, 0, kPad * 4);
    std::memset(row + length, 0, (stride - kPad - length) * 4);
}

// The masked image and target of one row, and 1 or 0 per value: three padded rows.
struct Rows {
    float *image, *target, *mask;
};

NEECO_INLINE void load_rows(const LossInputs& in, int y, const Rows& r, size_t stride) {
    const size_t start = (size_t)y * in.width * 3;
    const float* mask = in.mask ? in.mask + (size_t)y * in.width : nullptr;
    masked_row(in.image + start, mask, in.width, r.image);
    masked_row(in.target + start, mask, in.width, r.target);
    for (int x = 0; x < in.width; x++)
        for (int c = 0; c < 3; c++) r.mask[3 * x + c] = mask ? mask[x] : 1.f;
    for (float* row : {r.image, r.target, r.mask}) clear_ends(row, 3 * in.width, stride);
}

NEECO_INLINE void copy_row(const float* from, float* to, int length) { std::memcpy(to, from, (size_t)length * 4); }

// Fields of a band: blurred along rows; rows outside the image are zero.
enum Field { kImage, kImageSquare, kProduct, kTarget, kTargetSquare, kFields };

NEECO_INLINE void fill_fields(const LossInputs& in, int first, float* fields, float* spare, size_t stride) {
    const int length = 3 * in.width;
    const Rows rows = {spare + kPad, spare + stride + kPad, spare + 2 * stride + kPad};
    float* product = spare + 3 * stride + kPad;
    const size_t field = stride * kBandRows;
    clear_ends(product, length, stride);
    for (int r = 0; r < kBandRows; r++) {
        const int y = first + r - kReach;
        float* out = fields + stride * r;
        if (y < 0 || y >= in.height) {
            for (int f = 0; f < kFields; f++) std::memset(out + field * f, 0, stride * 4);
            continue;
        }
        load_rows(in, y, rows, stride);
        auto blur_product = [&](const float* a, const float* b, int f) {
            for (int i = 0; i < length; i++) product[i] = a[i] * b[i];
            blur_row(product, out + field * f, length);
        };
        blur_row(rows.image, out + field * kImage, length);
        blur_product(rows.image, rows.image, kImageSquare);
        blur_product(rows.image, rows.target, kProduct);
        blur_row(rows.target, out + field * kTarget, length);
        blur_product(rows.target, rows.target, kTargetSquare);
    }
}

// Sums SSIM over a band and writes the derivatives with respect to the three blurred image fields into `maps`.
static double ssim_band(const LossInputs& in, int band, float* maps, size_t map_size, float scale) {
    const size_t stride = padded_row(in.width), field = stride * kBandRows;
    const int length = 3 * in.width, first = band * kBand;
    float* spare = scratch(field * kFields + 8 * stride) + field * kFields;
    float* fields = spare - field * kFields;
    fill_fields(in, first, fields, spare, stride);
    const Rows rows = {spare + kPad, spare + stride + kPad, spare + 2 * stride + kPad};
    double total = 0;
    for (int y = first; y < lower(first + kBand, in.height); y++) {
        load_rows(in, y, rows, stride);
        const int r = y - first + kReach;
        float* out = maps + stride * y + kPad;
        vf sum_row = all(0.f);
        for (int i = 0; i < length; i += W) {
            const vf m = blur_column(fields + field * kImage, stride, r, i), mm = blur_column(fields + field * kImageSquare, stride, r, i);
            const vf mt = blur_column(fields + field * kProduct, stride, r, i);
            const vf t = blur_column(fields + field * kTarget, stride, r, i);
            const vf tt = blur_column(fields + field * kTargetSquare, stride, r, i);
            const vf a1 = 2.f * m * t + kC1, a2 = 2.f * (mt - m * t) + kC2;
            const vf b1 = m * m + t * t + kC1, b2 = (mm - m * m) + (tt - t * t) + kC2;
            const vf inverse = 1.f / (b1 * b2), ssim = a1 * a2 * inverse;
            const vf counted = load(rows.mask + i);  // also 0 beyond the row's end
            sum_row += counted * ssim;
            const vf weight = counted * scale;
            const vf by_b1 = -ssim * b2 * inverse, by_b2 = -ssim * b1 * inverse;
            store(out + i, weight * (2.f * t * (a2 - a1) * inverse + 2.f * m * (by_b1 - by_b2)));
            store(out + map_size + i, weight * by_b2);
            store(out + 2 * map_size + i, weight * 2.f * a1 * inverse);
        }
        for (int f = 0; f < 3; f++) clear_ends(out + f * map_size, length, stride);
        total += sum(sum_row);
    }
    return total;
}

// Sums |image - target| over a band and, if wanted, writes the gradient of the whole loss.
static double gradient_band(const LossInputs& in, int band, const float* maps, size_t map_size, float l1_scale, float* gradient) {
    const size_t stride = padded_row(in.width), field = stride * kBandRows;
    const int length = 3 * in.width, first = band * kBand;
    float* fields = scratch(field * kFields + 8 * stride);
    float* spare = fields + field * kFields;
    const Rows rows = {spare + kPad, spare + stride + kPad, spare + 2 * stride + kPad};
    float* result = spare + 4 * stride;
    for (int r = 0; r < kBandRows && gradient; r++) {
        const int y = first + r - kReach;
        for (int f = 0; f < 3; f++) {
            float* out = fields + field * f + stride * r;
            if (y < 0 || y >= in.height) std::memset(out, 0, stride * 4);
            else blur_row(maps + map_size * f + stride * y + kPad, out, length);
        }
    }
    double total = 0;
    for (int y = first; y < lower(first + kBand, in.height); y++) {
        load_rows(in, y, rows, stride);
        const int r = y - first + kReach;
        vf sum_row = all(0.f);
        for (int i = 0; i < length; i += W) {
            const vf image = load(rows.image + i), target = load(rows.target + i), difference = image - target;
            sum_row += difference > 0.f ? difference : -difference;
            if (!gradient) continue;
            vf g = blur_column(fields, stride, r, i) + 2.f * image * blur_column(fields + field, stride, r, i) +
                   target * blur_column(fields + 2 * field, stride, r, i);
            g += select(difference > 0.f, all(l1_scale), select(difference < 0.f, all(-l1_scale), all(0.f)));
            store(result + i, g * load(rows.mask + i));
        }
        if (gradient) copy_row(result, gradient + (size_t)y * length, length);
        total += sum(sum_row);
    }
    return total;
}

// The loss; gradient [H, W, 3] or null.
static double photometric(const LossInputs& in, Buffer<float>& work, float* gradient) {
    const size_t stride = padded_row(in.width), map_size = stride * in.height;
    const int bands = (in.height + kBand - 1) / kBand;
    float* maps = work.reserve(3 * map_size + 4 * (size_t)bands + 16);
    double* sums = (double*)(maps + (3 * map_size + 15) / 16 * 16);
    const double values = 3.0 * in.pixels;
    const float scale = (float)(-in.ssim_weight / values), l1_scale = (float)((1.0 - in.ssim_weight) / values);
    parallel_for(bands, [&](int band) { sums[band] = ssim_band(in, band, maps, map_size, scale); });
    parallel_for(bands, [&](int band) { sums[bands + band] = gradient_band(in, band, maps, map_size, l1_scale, gradient); });
    double ssim = 0, l1 = 0;
    for (int b = 0; b < bands; b++) {
        ssim += sums[b];
        l1 += sums[bands + b];
    }
    return (1.0 - in.ssim_weight) * l1 / values + in.ssim_weight * (1.0 - ssim / values);
}

}  // namespace NEECO_VARIANT
}  // namespace neeco
