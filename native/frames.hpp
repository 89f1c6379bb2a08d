// Frames between two drawings.
#pragma once

#include <algorithm>
#include <memory>
#include <mutex>
#include <vector>

#include "frame.hpp"
#include "parallel.hpp"

namespace neeco {

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
        if (idle_.size() < kept()) idle_.push_back(std::move(frame));
    }

private:
    static size_t kept() { return std::max(2, thread_count()); }

    std::mutex mutex_;
    std::vector<std::unique_ptr<Frame>> idle_;
};

inline FrameStore& store() {
    static auto* frames = new FrameStore;
    return *frames;
}

}  // namespace neeco
