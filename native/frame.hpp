// Plain data that passes between the stages of the rasteriser: inputs, outputs, gradients, and what one drawn frame keeps.
#pragma once

#include <cstddef>
#include <cstdint>
#include <cstdlib>
#include <utility>
#include <vector>

namespace neeco {

// End a call that cannot be carried out, by an exception where there are any.
[[noreturn]] void refuse(const char* why);
[[noreturn]] void out_of_memory();

// Aligned for the widest vectors; large blocks ask for huge pages. Freed by std::free. Ends in out_of_memory().
void* allocate(size_t bytes);

// Lets this process keep what it frees (up to 1 GiB) for its next allocations; false where the system has no such setting.
bool keep_freed_memory();

// Memory that is reused from frame to frame, not initialised.
template <class T>
class Buffer {
public:
    Buffer() = default;
    Buffer(const Buffer&) = delete;
    Buffer& operator=(const Buffer&) = delete;
    Buffer(Buffer&& other) noexcept : data_(other.data_), capacity_(other.capacity_) {
        other.data_ = nullptr;
        other.capacity_ = 0;
    }
    Buffer& operator=(Buffer&& other) noexcept {
        std::swap(data_, other.data_);
        std::swap(capacity_, other.capacity_);
        return *this;
    }
    ~Buffer() { std::free(data_); }

    // Room for at least n elements; contents are lost when it has to grow.
    T* reserve(size_t n) {
        if (n > capacity_) {
            std::free(data_);
            data_ = nullptr;
            capacity_ = 0;
            replace(n + n / 4 + 64);
        }
        return data_;
    }

    // The same, contents kept.
    T* grow(size_t n) {
        if (n > capacity_) {
            T* old = data_;
            const size_t kept = capacity_;
            replace(2 * n + 64);
            for (size_t i = 0; i < kept; i++) data_[i] = old[i];
            std::free(old);
        }
        return data_;
    }

    T* data() const { return data_; }
    size_t capacity() const { return capacity_; }

private:
    void replace(size_t n) {
        data_ = static_cast<T*>(allocate(n * sizeof(T)));
        capacity_ = n;
    }

    T* data_ = nullptr;
    size_t capacity_ = 0;
};

// Compiled once, in memory.cpp: never into the kernels' objects, whose instructions not every machine has.
extern template class Buffer<uint32_t>;
extern template class Buffer<int32_t>;
extern template class Buffer<float>;
extern template class Buffer<double>;
extern template class Buffer<uint64_t>;

struct Camera {
    float rotation[9];        // camera_from_world, row major
    float translation[3];     // camera_from_world, mm
    float centre[3];          // of the camera, world, mm
    double depth_row[4];      // last row of camera_from_world: depths are computed in double, then rounded once
    float fx, fy, cx, cy;     // px
    float nearest;            // mm
    float low_x, high_x;      // bounds of x/z where the projection is linearised: 1.3 x the field of view
    float low_y, high_y;
    int width, height;
};

struct GaussianInputs {
    int count = 0, sh_count = 0, channel_count = 0;
    const float* means = nullptr;       // [N, 3]
    const float* quats = nullptr;       // [N, 4]
    const float* scales = nullptr;      // [N, 3]
    const float* opacities = nullptr;   // [N]
    const float* sh = nullptr;          // [N, K, 3]
    const float* sh_frames = nullptr;   // [N, 4] or null
    const float* falloff = nullptr;     // [N] or null: no headlight
    const float* vignette = nullptr;    // [2], with falloff
    const float* channels = nullptr;    // [N, C] or null
    const float* gains = nullptr;       // [N] or null: by which colours are multiplied, > 0
};

struct Images {
    float* color;              // [H, W, 3]
    float* alpha;              // [H, W]
    float* depth;              // [H, W]
    float* channels;           // [H, W, C] or null
    float* radii;              // [N]
    const float* background;   // [3] or null
};

struct ImageGradients {
    const float* color;      // each may be null: zero
    const float* alpha;
    const float* depth;
    const float* channels;
    const float* drawn_alpha;  // what forward returned
    const float* drawn_depth;
    const float* background;
};

struct GaussianGradients {   // each may be null: not wanted
    float* means;
    float* quats;
    float* scales;
    float* opacities;
    float* sh;
    float* falloff;
    float* channels;
    float* gains;
    float* centers;          // [N, 2]
    float* vignette;         // [2]
    float* world_from_camera;  // [4, 4]
};

// One Gaussian as compositing sees it: log2(alpha) = A dx^2 + B dx dy + C dy^2 + log2_opacity with d = pixel - centre,
// followed in memory by the composited values: r, g, b, z, channels.
struct Record {
    float x, y, a, b, c, log2_opacity;
};
constexpr int kRecordHead = 6;

// One Gaussian in one tile: rows [first_row, end_row) of the tile's strip, and where its gradient goes.
struct Pair {
    uint32_t gaussian;
    uint32_t slot;
    uint16_t first_row, end_row;
};

// Where a Gaussian's pairs lie in its chunk's list (Gaussian order).
struct Span {
    uint32_t first, count;
};

constexpr int kChunkBits = 11;  // Gaussians are projected in chunks of 2048, whatever the number of threads
constexpr int kChunk = 1 << kChunkBits;

// A strip piece as projection emits it: tile | first row << 20 | last row << 26.
constexpr int kTileBits = 20, kRowBits = 6;

constexpr int kMostBands = 16;

// A visible Gaussian; the key is its depth's bits, which sort like the depth.
struct Visible {
    uint32_t key, gaussian;
};

// The pieces of one Gaussian in one band: `count` of them from `first` on in its chunk's (later, its band's) list.
struct Run {
    uint32_t key, gaussian, first, count;
};

// 2048 Gaussians as projection leaves them.
struct Chunk {
    Buffer<uint32_t> pieces;
    Buffer<Run> loose, runs;                 // in Gaussian order; the same, band by band
    uint32_t run_start[kMostBands + 1] = {}, band_pieces[kMostBands] = {};
    uint32_t piece_count = 0, visible = 0;
    uint32_t base = 0;                       // slot of the first piece
};

// A band of neighbouring columns of tiles, which is sorted and listed on its own: small enough to stay in cache.
struct Band {
    Buffer<Run> runs;
    Buffer<uint32_t> pieces, slots, next;    // slots: of each run's first piece; next: free place in each tile's list
    Buffer<uint64_t> order, spare;
};

enum Stage { kProject, kBin, kComposite, kCompositeBackward, kProjectBackward, kStages };

extern template class Buffer<Pair>;
extern template class Buffer<Span>;
extern template class Buffer<Visible>;
extern template class Buffer<Run>;

struct Frame {
    Camera camera;
    int count = 0, values = 0;               // Gaussians; composited values per pixel, padded to a compiled size
    int record_stride = 0;                   // floats
    int tile_width = 0, tile_height = 0;
    int tiles_x = 0, tiles_y = 0;            // tiles are numbered down the columns: x * tiles_y + y
    int bands = 0, band_columns = 0;         // the last band may be narrower
    Buffer<float> records;
    Buffer<Span> spans;
    std::vector<Chunk> chunks;
    Band band[kMostBands];
    Buffer<Visible> visible_list;            // chunk c's from c * kChunk on
    size_t visible = 0, pairs = 0;
    Buffer<uint32_t> tile_start, tile_order;
    Buffer<Pair> list;
    Buffer<float> transmittance;             // [H * W] after the last blended Gaussian
    Buffer<int32_t> last;                    // [H * W] position in the tile's list at which the pixel was full
    Buffer<float> slots;                     // gradients per pair, in Gaussian order
    Buffer<double> partial;                  // per-chunk sums
    double milliseconds[kStages] = {};

    int tiles() const { return tiles_x * tiles_y; }
    int slot_stride() const { return (kRecordHead + values + 7) / 8 * 8; }
};

}  // namespace neeco
