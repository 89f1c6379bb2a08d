// neeco._native: the photometric loss and Adam.

#include <cmath>

#include "arrays.hpp"
#include "kernels.hpp"

namespace neeco {
namespace {

double photometric(Array image, Array target, MaybeArray mask, float ssim_weight, double pixels, MaybeArray gradient) {
    if (target.ndim() != 3 || target.shape(2) != 3) throw std::invalid_argument("target: must be [H, W, 3]");
    LossInputs in{};
    in.height = static_cast<int>(target.shape(0));
    in.width = static_cast<int>(target.shape(1));
    in.image = sized(image, target.size(), "image");
    in.target = target.data();
    in.mask = sized(mask, target.shape(0) * target.shape(1), "mask");
    in.ssim_weight = ssim_weight;
    in.pixels = pixels;
    float* out = sized(gradient, target.size(), "gradient");
    static thread_local Buffer<float> work;
    const Kernels& k = kernels();
    nb::gil_scoped_release release;
    return k.photometric(in, work, out);
}

void adam(Array parameter, Array gradient, Array mean, Array square, double lr, double step, double beta1, double beta2, double eps) {
    AdamStep s{};
    s.count = parameter.size();
    s.parameter = parameter.data();
    s.gradient = sized(gradient, s.count, "grad");
    s.mean = sized(mean, s.count, "exp_avg");
    s.square = sized(square, s.count, "exp_avg_sq");
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
    m.def("photometric", &photometric, nb::arg(), nb::arg(), nb::arg().none(), nb::arg(), nb::arg(), nb::arg().none());
    m.def("adam", &adam);
}

}  // namespace neeco
