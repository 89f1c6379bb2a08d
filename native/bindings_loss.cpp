// neeco._native: the photometric loss and Adam.
#include <nanobind/stl/optional.h>

#include <cmath>

#include "arrays.hpp"
#include "kernels.hpp"

namespace neeco {
namespace {

LossInputs loss_inputs(const Array& target, const MaybeArray& mask) {
    if (target.ndim() != 3 || target.shape(2) != 3) throw std::invalid_argument("target: must be [H, W, 3]");
    LossInputs in{};
    in.height = static_cast<int>(target.shape(0));
    in.width = static_cast<int>(target.shape(1));
    in.target = target.data();
    const size_t pixels = static_cast<size_t>(in.height) * in.width;
    in.mask = sized(mask, pixels, "mask");
    return in;
}

double photometric(Array image, Array target, MaybeArray mask, MaybeArray target_mean, MaybeArray target_square, float ssim_weight,
                   double pixels, MaybeArray gradient) {
    LossInputs in = loss_inputs(target, mask);
    in.image = sized(image, target.size(), "image");
    in.target_mean = sized(target_mean, target.size(), "target_mean");
    in.target_square = sized(target_square, target.size(), "target_square");
    in.ssim_weight = ssim_weight;
    in.pixels = pixels;
    float* out = sized(gradient, target.size(), "gradient");
    static thread_local Buffer<float> work;
    const Kernels& k = kernels();
    nb::gil_scoped_release release;
    return k.photometric(in, work, out);
}

void blur_target(Array target, MaybeArray mask, Array mean, Array square) {
    const LossInputs in = loss_inputs(target, mask);
    float *to_mean = sized(mean, target.size(), "mean"), *to_square = sized(square, target.size(), "square");
    Buffer<float> work;
    const Kernels& k = kernels();
    nb::gil_scoped_release release;
    k.blur_target(in, work, to_mean, to_square);
}

void adam(Array parameter, Array gradient, Array mean, Array square, MaybeArray row_lr, double lr, double step, double beta1, double beta2,
          double eps) {
    AdamStep s{};
    s.count = parameter.size();
    s.parameter = parameter.data();
    s.gradient = sized(gradient, s.count, "grad");
    s.mean = sized(mean, s.count, "exp_avg");
    s.square = sized(square, s.count, "exp_avg_sq");
    const size_t rows = parameter.ndim() > 0 ? parameter.shape(0) : 1;
    s.row_lr = sized(row_lr, rows, "row_lr");
    s.row_length = rows ? s.count / rows : 1;
    s.lr = static_cast<float>(lr);
    s.beta1 = static_cast<float>(beta1);
    s.beta2 = static_cast<float>(beta2);
    s.eps = static_cast<float>(eps);
    s.correction1 = static_cast<float>(1 - std::pow(beta1, step));
    s.correction2_root = static_cast<float>(std::sqrt(1 - std::pow(beta2, step)));
    const Kernels& k = kernels();
    nb::gil_scoped_release release;
    k.adam(s);
}

}  // namespace

void bind_loss(nb::module_& m) {
    m.def("photometric", &photometric, nb::arg(), nb::arg(), nb::arg().none(), nb::arg().none(), nb::arg().none(), nb::arg(), nb::arg(),
          nb::arg().none());
    m.def("blur_target", &blur_target, nb::arg(), nb::arg().none(), nb::arg(), nb::arg());
    m.def("adam", &adam, nb::arg(), nb::arg(), nb::arg(), nb::arg(), nb::arg().none(), nb::arg(), nb::arg(), nb::arg(), nb::arg(),
          nb::arg());
}

}  // namespace neeco
