// neeco._native: posing bodies of links that joints move.
#include <nanobind/stl/tuple.h>
#include <nanobind/stl/vector.h>

#include <tuple>
#include <vector>

#include "arrays.hpp"
#include "kernels.hpp"

namespace neeco {
namespace {

// What is posed. Bodies follow each other in the rows, `counts` long; where a body's numbers are None it stands still. `how` says
// of each how many links it has, which joints slide (bits) and by how much it rolls.
class Posing {
public:
    Posing(Array means, Array quats, Array log_scales, MaybeArray logits, const std::vector<int>& counts,
           const std::vector<MaybeArray>& numbers, const std::vector<std::tuple<int, unsigned, float>>& how)
        : arrays_{means, quats, log_scales}, total_(means.size() / 3) {
        if (numbers.size() != counts.size() || how.size() != counts.size()) throw std::invalid_argument("bodies: one count, numbers and how each");
        const size_t n = total_;
        Body body{};
        body.total = static_cast<int>(n);
        body.means = means.data();
        body.quats = sized(quats, 4 * n, "quats");
        body.log_scales = sized(log_scales, 3 * n, "log_scales");
        if (logits) {
            if (logits->ndim() != 2 || logits->shape(0) != n) throw std::invalid_argument("logits: must be [N, L]");
            body.logit_count = static_cast<int>(logits->shape(1));
            body.logits = logits->data();
            logit_count_ = logits->shape(1);
            arrays_.push_back(*logits);
        }
        for (size_t i = 0; i < counts.size(); i++) {
            body.count = counts[i];
            body.numbers = data_of(numbers[i]);
            std::tie(body.links, body.slides, body.roll) = how[i];
            body.joints = 0;
            if (numbers[i]) {
                const size_t size = numbers[i]->size();
                if (body.links < 1 || body.links > kMostLinks) throw std::invalid_argument("links: too few or too many");
                const size_t each = joint_numbers(body.links);
                if (size < kBodyNumbers || (size - kBodyNumbers) % each) throw std::invalid_argument("numbers: of another length");
                if ((size - kBodyNumbers) / each > kMostJoints) throw std::invalid_argument("joints: too many");
                body.joints = static_cast<int>((size - kBodyNumbers) / each);
                arrays_.push_back(*numbers[i]);
            }
            if (body.joints && body.logit_count < body.links) throw std::invalid_argument("logits: too few columns");
            bodies_.push_back(body);
            body.first += counts[i];
        }
        if (body.first != body.total) throw std::invalid_argument("counts: do not sum to N");
    }

    void forward(Array means, Array quats, Array scales, Array frames) {
        const PosedRows out{sized(means, 3 * total_, "means"), sized(quats, 4 * total_, "quats"), sized(scales, 3 * total_, "scales"),
                            sized(frames, 4 * total_, "frames"), nullptr};
        const Kernels& k = kernels();
        nb::gil_scoped_release release;
        for (const Body& body : bodies_) k.pose(body, out);
    }

    // From gradients of means, quats and scales to those of what was given, zeros where nothing is written.
    void backward(Array means, Array quats, Array scales, Array to_means, Array to_quats, Array to_log_scales, MaybeArray to_logits,
                  const std::vector<MaybeArray>& to_numbers) {
        const PosedRows from{sized(means, 3 * total_, "means"), sized(quats, 4 * total_, "quats"), sized(scales, 3 * total_, "scales"), nullptr, nullptr};
        const PosedRows to{sized(to_means, 3 * total_, "means"), sized(to_quats, 4 * total_, "quats"), sized(to_log_scales, 3 * total_, "log_scales"),
                           nullptr, sized(to_logits, total_ * logit_count_, "logits")};
        if (to_numbers.size() != bodies_.size()) throw std::invalid_argument("numbers: one each");
        static thread_local Buffer<double> partial;
        const Kernels& k = kernels();
        nb::gil_scoped_release release;
        for (size_t i = 0; i < bodies_.size(); i++) k.pose_backward(bodies_[i], from, to, partial, data_of(to_numbers[i]));
    }

private:
    std::vector<Array> arrays_;
    std::vector<Body> bodies_;
    size_t total_, logit_count_ = 0;
};

}  // namespace

void bind_posing(nb::module_& m) {
    nb::class_<Posing>(m, "Posing")
        .def(nb::init<Array, Array, Array, MaybeArray, const std::vector<int>&, const std::vector<MaybeArray>&,
                      const std::vector<std::tuple<int, unsigned, float>>&>(),
             nb::arg(), nb::arg(), nb::arg(), nb::arg().none(), nb::arg(), nb::arg(), nb::arg())
        .def("forward", &Posing::forward)
        .def("backward", &Posing::backward, nb::arg(), nb::arg(), nb::arg(), nb::arg(), nb::arg(), nb::arg(), nb::arg().none(), nb::arg());
}

}  // namespace neeco
