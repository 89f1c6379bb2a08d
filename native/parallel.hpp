// A small pool of threads. Tasks are numbered; which thread runs which task is left open, so callers make every task write
// to places of its own and results never depend on scheduling. Waiting is done on condition variables, never by spinning:
// spinning threads ruin each other where other processes want the cores too.
#pragma once

#include <type_traits>

namespace neeco {

// Number of threads that take part in parallel_for, the calling one included.
int thread_count();

// Sets it; 0 means the default: cores this process may use, at most OMP_NUM_THREADS.
void set_thread_count(int count);

// Runs task(context, i) for i in [0, count) and returns when all have run. May be called from several threads at once and
// from inside a task: whoever finds the pool taken runs its own tasks itself.
void run_tasks(int count, void (*task)(void*, int), void* context);

template <class F>
inline void parallel_for(int count, F&& body) {
    using Body = typename std::remove_reference<F>::type;
    run_tasks(count, [](void* context, int i) { (*static_cast<Body*>(context))(i); }, const_cast<void*>(static_cast<const void*>(&body)));
}

}  // namespace neeco
