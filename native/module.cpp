// neeco._native: what Python sees of the kernels.
#include <nanobind/nanobind.h>

namespace neeco {
void bind_raster(nanobind::module_& m);
void bind_loss(nanobind::module_& m);
void bind_posing(nanobind::module_& m);
void bind_shadow(nanobind::module_& m);
}  // namespace neeco

NB_MODULE(_native, m) {
    // torch's autograd graph may hold drawings until after the interpreter has gone.
    nanobind::set_leak_warnings(false);
    m.doc() = "CPU kernels of neeco: use neeco.raster, not this.";
    neeco::bind_raster(m);
    neeco::bind_loss(m);
    neeco::bind_posing(m);
    neeco::bind_shadow(m);
}
