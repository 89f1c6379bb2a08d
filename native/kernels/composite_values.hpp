// Chooses the compiled number of composited values: colour, depth and the channels, rounded up.
#pragma once

#include "composite_backward.hpp"

namespace neeco {
namespace NEECO_VARIANT {

static void composite(Frame& frame, const Images& out, int channels, bool keep) {
    switch (frame.values) {
#define NEECO_CASE(V) case V: return keep ? composite_values<V, true>(frame, out, channels) : composite_values<V, false>(frame, out, channels);
        NEECO_VALUES(NEECO_CASE)
#undef NEECO_CASE
    }
}

static void composite_backward(Frame& frame, const ImageGradients& from, int channels) {
    switch (frame.values) {
#define NEECO_CASE(V) case V: return composite_backward_values<V>(frame, from, channels);
        NEECO_VALUES(NEECO_CASE)
#undef NEECO_CASE
    }
}

}  // namespace NEECO_VARIANT
}  // namespace neeco
