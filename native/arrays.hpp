// Tensors as the bindings take them: float32, C order, on the CPU; None where optional.
#pragma once

#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/optional.h>

#include <optional>
#include <stdexcept>
#include <string>

namespace neeco {

namespace nb = nanobind;
using Array = nb::ndarray<float, nb::c_contig, nb::device::cpu>;
using MaybeArray = std::optional<Array>;
using Flags = nb::ndarray<bool, nb::c_contig, nb::device::cpu>;

inline float* data_of(const MaybeArray& a) { return a ? a->data() : nullptr; }

// The array's memory, after checking that it holds `size` elements.
inline float* sized(const Array& a, size_t size, const char* name) {
    if (a.size() != size)
        throw std::invalid_argument(std::string(name) + ": has " + std::to_string(a.size()) + " elements, not " + std::to_string(size));
    return a.data();
}
inline float* sized(const MaybeArray& a, size_t size, const char* name) { return a ? sized(*a, size, name) : nullptr; }

}  // namespace neeco
