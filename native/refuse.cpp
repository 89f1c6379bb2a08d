// How the kernels refuse what they cannot do, where there are exceptions.
#include <new>
#include <stdexcept>

#include "frame.hpp"

namespace neeco {

void refuse(const char* why) { throw std::invalid_argument(why); }
void out_of_memory() { throw std::bad_alloc(); }

}  // namespace neeco
