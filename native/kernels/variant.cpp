// The kernels of one instruction set; CMakeLists.txt compiles this file once for each.
#include "composite_values.hpp"
#include "composite_alone.hpp"
#include "loss.hpp"
#include "adam.hpp"
#include "project.hpp"
#include "project_backward.hpp"
#include "posing.hpp"
#include "cast.hpp"
#include "visibility.hpp"

#define NEECO_TEXT2(x) #x
#define NEECO_TEXT(x) NEECO_TEXT2(x)
#define NEECO_JOIN2(a, b) a##b
#define NEECO_JOIN(a, b) NEECO_JOIN2(a, b)

namespace neeco {

const Kernels& NEECO_JOIN(kernels_, NEECO_VARIANT)() {
    namespace v = NEECO_VARIANT;
    static const Kernels table = {NEECO_TEXT(NEECO_VARIANT), v::W, v::kStrip, v::kTileHeight, v::project, v::composite,
                                  v::composite_backward, v::project_backward, v::photometric, v::adam, v::cast,
                                  v::cast_backward, v::pose, v::pose_backward, v::composite_alone, v::unobserved};
    return table;
}

}  // namespace neeco
