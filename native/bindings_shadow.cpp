// neeco._native: what shadows are made of: a blurred plane, what stands behind it, and harmonics dimmed.
#include <nanobind/stl/optional.h>

#include "arrays.hpp"
#include "kernels.hpp"
#include "parallel.hpp"
#include "shadow_map.hpp"

namespace neeco {
namespace {

// windows [2, T]: down and across; slopes [2, T], their derivatives, with `slope`, where that of the plane goes.
void blur(Array image, Array windows, MaybeArray slopes, Array out, MaybeArray slope) {
    if (image.ndim() != 2 || windows.ndim() != 2 || windows.shape(0) != 2 || windows.shape(1) % 2 == 0)
        throw std::invalid_argument("blur: image must be [H, W], windows [2, T] with T odd");
    if (slope && !slopes) throw std::invalid_argument("slope: needs the windows' slopes");
    const size_t taps = windows.shape(1);
    BlurInputs in{};
    in.height = static_cast<int>(image.shape(0));
    in.width = static_cast<int>(image.shape(1));
    in.reach = static_cast<int>(taps / 2);
    in.image = image.data();
    in.down = windows.data();
    in.across = in.down + taps;
    in.down_slope = sized(slopes, 2 * taps, "slopes");
    in.across_slope = in.down_slope ? in.down_slope + taps : nullptr;
    float *to = sized(out, image.size(), "out"), *to_slope = sized(slope, image.size(), "slope");
    static thread_local Buffer<float> work;
    const Kernels& k = kernels();
    nb::gil_scoped_release release;
    k.blur(in, work, to, to_slope);
}

void brighten(Array sh, Array factors, float half, Array out) {
    const size_t count = factors.size(), width = count ? sh.size() / count : 0;
    sized(sh, count * width, "sh");
    float* to = sized(out, sh.size(), "out");
    const Kernels& k = kernels();
    nb::gil_scoped_release release;
    k.brighten(static_cast<int>(count), static_cast<int>(width), half, sh.data(), factors.data(), to);
}

void brighten_backward(Array sh, Array factors, float half, Array gradient, Array to_sh, Array to_factors) {
    const size_t count = factors.size(), width = count ? sh.size() / count : 0;
    sized(sh, count * width, "sh");
    const float* from = sized(gradient, sh.size(), "gradient");
    float *to = sized(to_sh, sh.size(), "sh"), *factor = sized(to_factors, count, "factors");
    const Kernels& k = kernels();
    nb::gil_scoped_release release;
    k.brighten_backward(static_cast<int>(count), static_cast<int>(width), half, sh.data(), factors.data(), from, to, factor);
}

// Points [N, 3] in the frame of a camera at the place of which a lamp stands off by `offset`, and the lamp's map of what casts.
struct Cast {
    const float *alpha, *weighted, *points, *casters, *offset, *focus;  // casters [N]: 1 or 0; focus: fx, fy, cx, cy
    float nearest;
    int width, height, count;

    struct Place {
        float x, y, z, column, row;
    };
    Place place(int n) const {
        const float x = points[3 * n] - offset[0], y = points[3 * n + 1] - offset[1], z = points[3 * n + 2] - offset[2];
        const float deep = std::max(z, nearest);
        return {x, y, z, x / deep * focus[0] + focus[2], y / deep * focus[1] + focus[3]};
    }
    Blocked blocked(const Place& p) const { return blocked_at(alpha, weighted, width, height, p.column, p.row, p.z); }
};

Cast cast_of(const Array& alpha, const Array& weighted, const Array& points, const Array& casters, const Array& offset, const Array& focus,
             float nearest) {
    if (alpha.ndim() != 2) throw std::invalid_argument("alpha: must be [H, W]");
    const size_t count = casters.size();
    return {alpha.data(), sized(weighted, alpha.size(), "weighted"), sized(points, 3 * count, "points"), casters.data(),
            sized(offset, 3, "offset"), sized(focus, 4, "focus"), nearest, static_cast<int>(alpha.shape(1)),
            static_cast<int>(alpha.shape(0)), static_cast<int>(count)};
}

constexpr int kCastRows = 1024;  // per task

void behind(Array alpha, Array weighted, Array points, Array casters, Array offset, Array focus, float nearest, Array out) {
    const Cast in = cast_of(alpha, weighted, points, casters, offset, focus, nearest);
    float* to = sized(out, casters.size(), "out");
    nb::gil_scoped_release release;
    parallel_for((in.count + kCastRows - 1) / kCastRows, [&](int task) {
        for (int n = task * kCastRows; n < std::min((task + 1) * kCastRows, in.count); n++) {
            const Blocked found = in.blocked(in.place(n));
            to[n] = found.hit && in.casters[n] == 0 ? found.share.value : 0.f;
        }
    });
}

// Adds to the map's gradient [H, W] and to the offset's [3]; drawn: what `behind` found. By one thread: rows share pixels, and few are behind anything.
void behind_backward(Array alpha, Array weighted, Array points, Array casters, Array offset, Array focus, float nearest, Array drawn,
                     Array gradient, Array to_alpha, Array to_offset) {
    const Cast in = cast_of(alpha, weighted, points, casters, offset, focus, nearest);
    const float *from = sized(gradient, casters.size(), "gradient"), *share = sized(drawn, casters.size(), "drawn");
    float *map = sized(to_alpha, alpha.size(), "to_alpha"), *to = sized(to_offset, 3, "to_offset");
    const float fx = in.focus[0], fy = in.focus[1];
    nb::gil_scoped_release release;
    for (int n = 0; n < in.count; n++) {
        if (share[n] == 0) continue;
        const Cast::Place p = in.place(n);
        const Blocked found = in.blocked(p);
        add_between(map, in.width, in.height, p.column, p.row, from[n]);
        // the point moves across the map as the lamp does, and to first order so does the map of what casts
        const float across = from[n] * found.share.across, down = from[n] * found.share.down;
        const float deep = std::max(p.z, in.nearest), by_depth = p.z > in.nearest ? 1 / (deep * deep) : 0.f;
        to[0] += across * fx * (1 / found.before - 1 / deep);
        to[1] += down * fy * (1 / found.before - 1 / deep);
        to[2] += across * (fx * p.x * by_depth - (p.column - in.focus[2]) / found.before) +
                 down * (fy * p.y * by_depth - (p.row - in.focus[3]) / found.before);
    }
}

}  // namespace

void bind_shadow(nb::module_& m) {
    m.def("blur", &blur, nb::arg(), nb::arg(), nb::arg().none(), nb::arg(), nb::arg().none());
    m.def("behind", &behind);
    m.def("behind_backward", &behind_backward);
    m.def("brighten", &brighten);
    m.def("brighten_backward", &brighten_backward);
}

}  // namespace neeco
