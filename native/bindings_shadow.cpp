// neeco._native: what of a lamp's light Gaussians miss, and what of them no training frame saw.
#include <cstring>

#include "arrays.hpp"
#include "kernels.hpp"

namespace neeco {
namespace {

using Places = nb::ndarray<int32_t, nb::c_contig, nb::device::cpu>;

// maps [3, H, W] and where they lie, int [4]: what `cast` leaves for the gradient. numbers [21]: rotation [9] and centre [3] of the camera, offset [3], fx, fy, cx,
// cy, sigma, nearest (as CastInputs has them).
CastInputs cast_inputs(const Array& means, const Flags& casters, const Array& numbers, const Array& maps) {
    if (maps.ndim() != 3 || maps.shape(0) != 3) throw std::invalid_argument("maps: must be [3, H, W]");
    CastInputs in{};
    in.count = static_cast<int>(casters.size());
    in.height = static_cast<int>(maps.shape(1)), in.width = static_cast<int>(maps.shape(2));
    in.means = sized(means, 3 * casters.size(), "means");
    in.casters = casters.data();
    const float* from = sized(numbers, 21, "numbers");
    std::memcpy(in.rotation, from, sizeof in.rotation);
    std::memcpy(in.centre, from + 9, sizeof in.centre);
    std::memcpy(in.offset, from + 12, sizeof in.offset);
    in.fx = from[15], in.fy = from[16], in.cx = from[17], in.cy = from[18], in.sigma = from[19], in.nearest = from[20];
    return in;
}

void cast(Array alpha, Array depth, Array means, Flags casters, Array numbers, bool slope, Array maps, Places place, Array shares) {
    CastInputs in = cast_inputs(means, casters, numbers, maps);
    const size_t size = maps.size() / 3;
    in.alpha = sized(alpha, size, "alpha"), in.depth = sized(depth, size, "depth");
    float* to = sized(shares, casters.size(), "shares");
    if (place.size() != 4) throw std::invalid_argument("place: must have 4 elements");
    static thread_local Buffer<float> work;
    const Kernels& k = kernels();
    nb::gil_scoped_release release;
    const CastMaps m = k.cast(in, work, maps.data(), slope, to);
    const int found[4] = {m.left, m.top, m.width, m.height};
    std::memcpy(place.data(), found, sizeof found);
}

void cast_backward(Array means, Flags casters, Array numbers, Array maps, Places place, Array shares, Array gradient, Array out) {
    const CastInputs in = cast_inputs(means, casters, numbers, maps);
    if (place.size() != 4) throw std::invalid_argument("place: must have 4 elements");
    const int* p = place.data();
    const size_t size = static_cast<size_t>(p[2]) * p[3];
    if (3 * size > maps.size()) throw std::invalid_argument("place: is larger than the maps");
    const CastMaps m = {p[0], p[1], p[2], p[3], maps.data(), maps.data() + size, maps.data() + 2 * size};
    const float *found = sized(shares, casters.size(), "shares"), *from = sized(gradient, casters.size(), "gradient");
    float* to = sized(out, 4, "out");
    static thread_local Buffer<double> partial;
    const Kernels& k = kernels();
    nb::gil_scoped_release release;
    k.cast_backward(in, m, found, from, partial, to);
}

// numbers [4]: the camera's centre, and the visibility of what is half unobserved.
void unobserved(Array means, MaybeArray frames, Array visibility, Array directions, Array numbers, Array shares) {
    const size_t n = shares.size();
    ViewInputs in{};
    in.count = static_cast<int>(n);
    in.means = sized(means, 3 * n, "means");
    in.frames = sized(frames, 4 * n, "frames");
    in.visibility = sized(visibility, kViewDirections * n, "visibility");
    in.directions = sized(directions, 3 * kViewDirections, "directions");
    const float* from = sized(numbers, 4, "numbers");
    std::memcpy(in.centre, from, sizeof in.centre);
    in.half = from[3];
    const Kernels& k = kernels();
    nb::gil_scoped_release release;
    k.unobserved(in, shares.data());
}

}  // namespace

void bind_shadow(nb::module_& m) {
    m.def("cast", &cast);
    m.def("cast_backward", &cast_backward);
    m.def("unobserved", &unobserved, nb::arg(), nb::arg().none(), nb::arg(), nb::arg(), nb::arg(), nb::arg());
}

}  // namespace neeco
