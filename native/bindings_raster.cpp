// neeco._native: drawing and its gradient. Python holds a Drawing between the two.
#include <nanobind/stl/string.h>
#include <nanobind/stl/vector.h>

#include <cmath>
#include <memory>
#include <mutex>
#include <vector>

#include "arrays.hpp"
#include "kernels.hpp"
#include "parallel.hpp"

namespace neeco {
namespace {

// Frames are tens of megabytes that the system would have to clear again and again: keep a few.
class FrameStore {
public:
    std::unique_ptr<Frame> take() {
        std::lock_guard<std::mutex> lock(mutex_);
        if (idle_.empty()) return std::make_unique<Frame>();
        auto frame = std::move(idle_.back());
        idle_.pop_back();
        return frame;
    }
    void give(std::unique_ptr<Frame> frame) {
        std::lock_guard<std::mutex> lock(mutex_);
        if (idle_.size() < 2) idle_.push_back(std::move(frame));
    }

private:
    std::mutex mutex_;
    std::vector<std::unique_ptr<Frame>> idle_;
};

FrameStore& store() {
    static auto* frames = new FrameStore;
    return *frames;
}

Camera camera_from(const Array& world_from_camera, float fx, float fy, float cx, float cy, int width, int height, float nearest) {
    const float* m = sized(world_from_camera, 16, "world_from_camera");
    if (width <= 0 || height <= 0) throw std::invalid_argument("camera: width and height must be positive");
    Camera c;
    for (int i = 0; i < 3; i++) {
        double t = 0;
        for (int j = 0; j < 3; j++) {
            c.rotation[3 * i + j] = m[4 * j + i];
            c.depth_row[j] = m[4 * j + 2];
            t -= static_cast<double>(m[4 * j + i]) * m[4 * j + 3];
        }
        c.translation[i] = static_cast<float>(t);
        c.centre[i] = m[4 * i + 3];
        if (i == 2) c.depth_row[3] = t;
    }
    c.fx = fx, c.fy = fy, c.cx = cx, c.cy = cy;
    c.width = width, c.height = height;
    c.nearest = nearest;
    const float margin_x = 0.15f * width / fx, margin_y = 0.15f * height / fy;
    c.low_x = -cx / fx - margin_x, c.high_x = (width - cx) / fx + margin_x;
    c.low_y = -cy / fy - margin_y, c.high_y = (height - cy) / fy + margin_y;
    return c;
}

// Of the latest drawing and gradient, for the benchmark.
struct Statistics {
    std::mutex mutex;
    double milliseconds[kStages] = {};
    size_t visible = 0, pairs = 0;

    void take(const Frame& frame) {
        std::lock_guard<std::mutex> lock(mutex);
        for (int i = 0; i < kStages; i++) milliseconds[i] = frame.milliseconds[i];
        visible = frame.visible;
        pairs = frame.pairs;
    }
};

Statistics& latest() {
    static Statistics statistics;
    return statistics;
}

nb::dict last_statistics() {
    static const char* names[kStages] = {"project", "bin", "composite", "composite_backward", "project_backward"};
    nb::dict d;
    for (int i = 0; i < kStages; i++) d[names[i]] = latest().milliseconds[i];
    d["visible"] = latest().visible;
    d["pairs"] = latest().pairs;
    return d;
}

// One drawn image: its inputs, kept alive, and what the gradient needs.
class Drawing {
public:
    Drawing(Array means, Array quats, Array scales, Array opacities, Array sh, MaybeArray sh_frames, MaybeArray falloff,
            MaybeArray vignette, MaybeArray gains, MaybeArray channels, MaybeArray background, Array world_from_camera, float fx, float fy, float cx, float cy,
            int width, int height, float nearest)
        : frame_(store().take()), arrays_{means, quats, scales, opacities, sh} {
        const size_t n = opacities.size();
        if (sh.ndim() != 3) throw std::invalid_argument("sh: must be [N, K, 3]");
        const size_t k = sh.shape(1);
        if (k != 1 && k != 4 && k != 9 && k != 16) throw std::invalid_argument("sh: K must be 1, 4, 9 or 16");
        const size_t c = channels ? channels->shape(1) : 0;
        if (c > static_cast<size_t>(kMostChannels)) throw std::invalid_argument("channels: at most 32");
        in_.count = static_cast<int>(n);
        in_.sh_count = static_cast<int>(k);
        in_.channel_count = static_cast<int>(c);
        in_.means = sized(means, 3 * n, "means");
        in_.quats = sized(quats, 4 * n, "quats");
        in_.scales = sized(scales, 3 * n, "scales");
        in_.opacities = opacities.data();
        in_.sh = sized(sh, 3 * k * n, "sh");
        in_.sh_frames = sized(sh_frames, 4 * n, "sh_frames");
        in_.falloff = sized(falloff, n, "falloff");
        in_.vignette = sized(vignette, 2, "vignette");
        in_.gains = sized(gains, n, "gains");
        in_.channels = sized(channels, c * n, "channels");
        background_ = sized(background, 3, "background");
        for (const MaybeArray& a : {sh_frames, falloff, vignette, gains, channels, background})
            if (a) arrays_.push_back(*a);
        frame_->camera = camera_from(world_from_camera, fx, fy, cx, cy, width, height, nearest);
    }
    ~Drawing() {
        if (frame_) store().give(std::move(frame_));
    }
    Drawing(const Drawing&) = delete;

    void forward(Array color, Array alpha, Array depth, MaybeArray channels, Array radii, bool keep) {
        const size_t pixels = this->pixels();
        const Images out{sized(color, 3 * pixels, "color"), sized(alpha, pixels, "alpha"), sized(depth, pixels, "depth"),
                         sized(channels, pixels * in_.channel_count, "channels"), sized(radii, in_.count, "radii"), background_};
        kernels_ = &kernels();
        nb::gil_scoped_release release;
        draw(*frame_, *kernels_, in_, out, keep);
        latest().take(*frame_);
    }

    // Alpha and depth [H, W] of the chosen Gaussians [N] without the others, after forward, whose alpha and depth are given.
    void alone(Flags chosen, Array drawn_alpha, Array drawn_depth, Array alpha, Array depth) {
        const size_t p = pixels();
        if (chosen.size() != static_cast<size_t>(in_.count)) throw std::invalid_argument("alone: one flag for every Gaussian expected");
        const float *from_alpha = sized(drawn_alpha, p, "alpha"), *from_depth = sized(drawn_depth, p, "depth");
        float *to_alpha = sized(alpha, p, "alpha"), *to_depth = sized(depth, p, "depth");
        if (!kernels_) throw std::runtime_error("alone before forward");
        nb::gil_scoped_release release;
        kernels_->composite_alone(*frame_, chosen.data(), from_alpha, from_depth, to_alpha, to_depth);
    }

    // Gradients of the images in the order of forward, then where the gradients of the Gaussians go.
    void backward(MaybeArray color, MaybeArray alpha, MaybeArray depth, MaybeArray channels, Array drawn_alpha, Array drawn_depth,
                  const std::vector<MaybeArray>& to) {
        const size_t p = pixels(), n = in_.count;
        if (to.size() != 11) throw std::invalid_argument("backward: eleven gradients expected");
        const ImageGradients from{sized(color, 3 * p, "color"), sized(alpha, p, "alpha"), sized(depth, p, "depth"),
                                  sized(channels, p * in_.channel_count, "channels"), sized(drawn_alpha, p, "alpha"),
                                  sized(drawn_depth, p, "depth"), background_};
        const GaussianGradients gradients{sized(to[0], 3 * n, "means"), sized(to[1], 4 * n, "quats"), sized(to[2], 3 * n, "scales"),
                                          sized(to[3], n, "opacities"), sized(to[4], 3 * n * in_.sh_count, "sh"), sized(to[5], n, "falloff"),
                                          sized(to[6], n * in_.channel_count, "channels"), sized(to[7], n, "gains"),
                                          sized(to[8], 2 * n, "centers"), sized(to[9], 2, "vignette"),
                                          sized(to[10], 16, "world_from_camera")};
        if (!kernels_) throw std::runtime_error("backward before forward");
        nb::gil_scoped_release release;
        draw_backward(*frame_, *kernels_, in_, from, gradients);
        latest().take(*frame_);
    }

private:
    size_t pixels() const { return static_cast<size_t>(frame_->camera.width) * frame_->camera.height; }

    std::unique_ptr<Frame> frame_;
    std::vector<Array> arrays_;
    GaussianInputs in_;
    const float* background_ = nullptr;
    const Kernels* kernels_ = nullptr;
};

}  // namespace

void bind_raster(nb::module_& m) {
    nb::class_<Drawing>(m, "Drawing")
        .def(nb::init<Array, Array, Array, Array, Array, MaybeArray, MaybeArray, MaybeArray, MaybeArray, MaybeArray, MaybeArray, Array,
                      float, float, float, float, int, int, float>(),
             nb::arg(), nb::arg(), nb::arg(), nb::arg(), nb::arg(), nb::arg().none(), nb::arg().none(), nb::arg().none(), nb::arg().none(),
             nb::arg().none(), nb::arg().none(), nb::arg(), nb::arg(), nb::arg(), nb::arg(), nb::arg(), nb::arg(), nb::arg(), nb::arg())
        .def("forward", &Drawing::forward, nb::arg(), nb::arg(), nb::arg(), nb::arg().none(), nb::arg(), nb::arg())
        .def("alone", &Drawing::alone)
        .def("backward", &Drawing::backward, nb::arg().none(), nb::arg().none(), nb::arg().none(), nb::arg().none(), nb::arg(), nb::arg(),
             nb::arg());
    m.def("last_statistics", &last_statistics);
    m.def("keep_freed_memory", &keep_freed_memory);
    m.def("thread_count", &thread_count);
    m.def("set_thread_count", &set_thread_count);
    m.def("simd", [] { return std::string(kernels().name); });
    m.def("select_simd", [](const std::string& name) { select_kernels(name.c_str()); });
    m.def("runnable_simd", [] {
        std::vector<std::string> names;
        for (const char* n : runnable_kernels()) names.emplace_back(n);
        return names;
    });
}

}  // namespace neeco
