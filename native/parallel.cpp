#include "parallel.hpp"

#include <algorithm>
#include <atomic>
#include <condition_variable>
#include <cstdlib>
#include <mutex>
#include <thread>
#include <vector>

#ifdef __linux__
#include <sched.h>
#endif
#ifndef _WIN32
#include <pthread.h>
#endif

namespace neeco {
namespace {

int default_threads() {
    int cores = std::max(1u, std::thread::hardware_concurrency());
#ifdef __linux__
    cpu_set_t allowed;
    if (sched_getaffinity(0, sizeof allowed, &allowed) == 0) cores = std::max(1, CPU_COUNT(&allowed));
#endif
    if (const char* limit = std::getenv("OMP_NUM_THREADS")) {
        const int n = std::atoi(limit);
        if (n > 0) cores = std::min(cores, n);
    }
    return cores;
}

// One job at a time. A worker joins a job only while tasks are left, and the caller waits only for workers that joined: a
// worker that the system has not woken yet costs nothing.
class Pool {
public:
    explicit Pool(int threads) {
        for (int i = 1; i < threads; i++) workers_.emplace_back([this] { work(); });
    }

    ~Pool() {
        {
            std::lock_guard<std::mutex> lock(mutex_);
            stopping_ = true;
        }
        wake_.notify_all();
        for (auto& worker : workers_) worker.join();
    }

    void run(int count, void (*task)(void*, int), void* context) {
        {
            std::lock_guard<std::mutex> lock(mutex_);
            task_ = task;
            context_ = context;
            count_ = count;
            next_.store(0, std::memory_order_relaxed);
            open_ = true;
        }
        const int helpers = std::min<int>(count - 1, static_cast<int>(workers_.size()));
        for (int i = 0; i < helpers; i++) wake_.notify_one();
        take_tasks();
        std::unique_lock<std::mutex> lock(mutex_);
        open_ = false;
        done_.wait(lock, [this] { return joined_ == 0; });
    }

private:
    void take_tasks() {
        for (int i; (i = next_.fetch_add(1, std::memory_order_relaxed)) < count_;) task_(context_, i);
    }

    void work() {
        std::unique_lock<std::mutex> lock(mutex_);
        for (;;) {
            wake_.wait(lock, [this] { return stopping_ || (open_ && next_.load(std::memory_order_relaxed) < count_); });
            if (stopping_) return;
            joined_++;
            lock.unlock();
            take_tasks();
            lock.lock();
            if (--joined_ == 0) done_.notify_one();
        }
    }

    std::mutex mutex_;
    std::condition_variable wake_, done_;
    std::vector<std::thread> workers_;
    void (*task_)(void*, int) = nullptr;
    void* context_ = nullptr;
    int count_ = 0, joined_ = 0;
    std::atomic<int> next_{0};
    bool open_ = false, stopping_ = false;
};

struct State {
    std::mutex busy;  // held by whoever uses the pool
    std::atomic<int> threads{default_threads()};
    Pool* pool = nullptr;
    int pool_threads = 0;
};

// Never destroyed: at exit, and in the child of a fork, the workers may already be gone.
State* state = nullptr;

State& shared() {
    static std::once_flag once;
    std::call_once(once, [] {
        state = new State;
#ifndef _WIN32
        pthread_atfork(nullptr, nullptr, [] {
            const int threads = state->threads;
            state = new State;
            state->threads = threads;
        });
#endif
    });
    return *state;
}

}  // namespace

int thread_count() { return shared().threads; }

void set_thread_count(int count) { shared().threads = count > 0 ? count : default_threads(); }

void run_tasks(int count, void (*task)(void*, int), void* context) {
    State& s = shared();
    const int threads = s.threads;
    if (count > 1 && threads > 1) {
        std::unique_lock<std::mutex> use(s.busy, std::try_to_lock);
        if (use.owns_lock()) {
            if (s.pool_threads != threads) {
                delete s.pool;
                s.pool = new Pool(threads);
                s.pool_threads = threads;
            }
            s.pool->run(count, task, context);
            return;
        }
    }
    for (int i = 0; i < count; i++) task(context, i);
}

}  // namespace neeco
