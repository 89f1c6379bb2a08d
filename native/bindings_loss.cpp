// neeco._native: the photometric loss and Adam.
#include "arrays.hpp"
#include "kernels.hpp"

namespace neeco {
void bind_loss(nb::module_& m) { (void)m; }
}  // namespace neeco
