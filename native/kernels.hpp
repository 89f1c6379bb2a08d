// The functions that exist once per instruction set, as a table.
#pragma once

#include "frame.hpp"

namespace neeco {

struct LossInputs {
    int height, width;
    const float* image;         // [H, W, 3]
    const float* target;        // [H, W, 3]
    const float* mask;          // [H, W] 0 or 1, or null
    float ssim_weight;
    double pixels;              // unmasked pixels
};

struct AdamStep {
    float* parameter;
    const float* gradient;
    float* mean;                // exp_avg
    float* square;              // exp_avg_sq
    size_t count;
    float lr, beta1, beta2, eps, correction1, correction2_root;
};

struct Kernels {
    const char* name;
    int width;                  // floats per vector
    int tile_width, tile_height;
    void (*project)(Frame&, const GaussianInputs&, float* radii);
    void (*composite)(Frame&, const Images&, int channel_count, bool keep);
    void (*composite_backward)(Frame&, const ImageGradients&, int channel_count);
    void (*project_backward)(Frame&, const GaussianInputs&, const GaussianGradients&);
    double (*photometric)(const LossInputs&, Buffer<float>& work, float* gradient);
    void (*adam)(const AdamStep&);
};

// The table for this machine, or the one NEECO_SIMD asks for; throws std::runtime_error when that cannot run here.
const Kernels& kernels();

// Names this build holds and this machine can run, widest last.
std::vector<const char*> runnable_kernels();

// Chooses by name ("" = the default) for the rest of the process.
void select_kernels(const char* name);

// Numbers of composited values that the kernels are compiled for: colour, depth and 0, 1, 2, 4, 8, 16, 32 channels.
#define NEECO_VALUES(X) X(4) X(5) X(6) X(8) X(12) X(20) X(36)
constexpr int kMostChannels = 32;

// Groups the pieces of a chunk that was just projected by band.
void group_by_band(Frame& frame, int chunk);

// Lists the visible Gaussians per tile, near to far (equal depths by index).
void list_per_tile(Frame& frame);

void draw(Frame& frame, const Kernels& k, const GaussianInputs& in, const Images& out, bool keep);
void draw_backward(Frame& frame, const Kernels& k, const GaussianInputs& in, const ImageGradients& from,
                   const GaussianGradients& to);

}  // namespace neeco
