#include "columns.hpp"

#include <algorithm>

#include "frames.hpp"
#include "parallel.hpp"

namespace neeco {
namespace {

// color: over black; becomes the composited image.
void composite_over(float* color, const float* alpha, const float* under, size_t pixels) {
    for (size_t i = 0; i < pixels; i++) {
        const float left = 1.f - alpha[i];
        for (int c = 0; c < 3; c++) color[3 * i + c] += left * under[3 * i + c];
    }
}

// Means over squares of `many` pixels along each side.
void reduce(const float* image, int height, int width, int many, float* out) {
    const int rows = height / many, row = 3 * (width / many);
    const float share = 1.f / static_cast<float>(many * many);
    for (int y = 0; y < rows; y++, out += row) {
        std::fill(out, out + row, 0.f);
        for (int k = 0; k < many; k++) {
            const float* from = image + static_cast<size_t>(y * many + k) * width * 3;
            for (int x = 0; x < row / 3; x++)
                for (int j = 0; j < many; j++, from += 3)
                    for (int c = 0; c < 3; c++) out[3 * x + c] += from[c];
        }
        for (int i = 0; i < row; i++) out[i] *= share;
    }
}

// image becomes its weighted difference.
void weigh(float* image, const Comparison& c, float change, size_t pixels) {
    const float unit = 1.f / change;
    for (size_t i = 0; i < pixels; i++) {
        const float factor = c.weight[i] * unit;
        for (int k = 0; k < 3; k++) image[3 * i + k] = (image[3 * i + k] - c.image[3 * i + k]) * factor;
    }
}

// By (1, 2, 1) / 4 down the columns, then along the rows.
void blur(const float* image, int height, int width, float* down, float* out) {
    const int row = 3 * width;
    for (int y = 0; y < height; y++, image += row, out += row) {
        for (int i = 0; i < row; i++) down[i] = 0.5f * image[i];
        if (y > 0)
            for (int i = 0; i < row; i++) down[i] += 0.25f * image[i - row];
        if (y + 1 < height)
            for (int i = 0; i < row; i++) down[i] += 0.25f * image[i + row];
        for (int i = 0; i < row; i++) out[i] = 0.5f * down[i];
        for (int i = 3; i < row; i++) out[i] += 0.25f * down[i - 3];
        for (int i = 0; i + 3 < row; i++) out[i] += 0.25f * down[i + 3];
    }
}

}  // namespace

void columns(const Kernels& k, const std::vector<ColumnInputs>& columns, const Comparison& c) {
    parallel_for(static_cast<int>(columns.size()), [&](int number) {
        const ColumnInputs& in = columns[number];
        static thread_local Buffer<float> work;
        const size_t pixels = static_cast<size_t>(c.height) * c.width;
        const int height = c.height / c.reduction, width = c.width / c.reduction;
        const size_t small = static_cast<size_t>(height) * width;
        float* color = work.reserve(5 * pixels + in.gaussians.count + 3 * small + 3 * width);
        float *alpha = color + 3 * pixels, *depth = alpha + pixels, *radii = depth + pixels;
        float *reduced = radii + in.gaussians.count, *down = reduced + 3 * small;
        auto frame = store().take();
        frame->camera = in.camera;
        draw(*frame, k, in.gaussians, Images{color, alpha, depth, nullptr, radii, nullptr}, false);
        store().give(std::move(frame));
        composite_over(color, alpha, c.under, pixels);
        if (c.reduction > 1) reduce(color, c.height, c.width, c.reduction, reduced);
        float* image = c.reduction > 1 ? reduced : color;
        weigh(image, c, in.change, small);
        blur(image, height, width, down, in.out);
    });
}

}  // namespace neeco
