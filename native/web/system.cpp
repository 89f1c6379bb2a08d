// What the kernels ask of their surroundings, in a page: one thread, and a trap where a Python process would get an exception.
#include "frame.hpp"
#include "parallel.hpp"

namespace neeco {

void refuse(const char*) { __builtin_trap(); }
void out_of_memory() { __builtin_trap(); }

void run_tasks(int count, void (*task)(void*, int), void* context) {
    for (int i = 0; i < count; i++) task(context, i);
}

}  // namespace neeco
