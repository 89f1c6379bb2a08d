// Derivatives of a rendered layer's residual by finite differences: a column of the Jacobian for every layer.
#pragma once

#include <vector>

#include "kernels.hpp"

namespace neeco {

// What a layer is rendered over and compared with.
struct Comparison {
    int height, width;    // of the layers, multiples of `reduction`
    int reduction;        // px of a layer along each side of a compared one
    const float* under;   // [H, W, 3], what a layer is composited over
    const float* image;   // [H / reduction, W / reduction, 3], subtracted
    const float* weight;  // [H / reduction, W / reduction]
};

struct ColumnInputs {
    Camera camera;
    GaussianInputs gaussians;
    float change;  // of the parameter
    float* out;    // [H / reduction, W / reduction, 3]
};

// ((layer over `under`, reduced) - image) / change * weight, blurred by the 3x3 binomial, zero outside. One column is one task.
void columns(const Kernels& k, const std::vector<ColumnInputs>& columns, const Comparison& c);

}  // namespace neeco
