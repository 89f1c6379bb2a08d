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

// A lamp and the Gaussians that its light may reach. What casts was drawn from the lamp by a camera turned as the image's.
struct CastInputs {
    int count, height, width;    // Gaussians; the map
    const float *alpha, *depth;  // [H, W] of what casts
    const float* means;          // [N, 3] mm, world
    const bool* casters;         // [N], which miss nothing; or null
    float rotation[9], centre[3], offset[3];  // camera_from_world and centre of the image's camera; the lamp's place in its frame
    float fx, fy, cx, cy, sigma, nearest;     // px, px (how far the map is blurred), mm
};

// What `cast` makes of the map [H, W], where anything casts: `left` and `top` say where that lies.
struct CastMaps {
    int left, top, width, height;
    float *opacity, *weighted, *slope;  // blurred; times depth; the opacity's derivative by sigma
};

struct AdamStep {
    float* parameter;
    const float* gradient;
    float* mean;                // exp_avg
    float* square;              // exp_avg_sq
    size_t count;
    float lr, beta1, beta2, eps, correction1, correction2_root;
};

// The rows [first, first + count) of the Gaussians: one body, its links moved by joints, then all of it to the world.
struct Body {
    int total;                  // Gaussians in all
    int first, count;
    int joints, links;          // link 0 moves with no joint; links <= logit_count where there are joints
    int logit_count;
    unsigned slides;            // bit j: joint j slides along its axis, the others turn about theirs
    const float* means;         // [N, 3]
    const float* quats;         // [N, 4]
    const float* log_scales;    // [N, 3]
    const float* logits;        // [N, logit_count], with joints
    const float* numbers;       // kBodyNumbers and joint_numbers() for every joint, or null: the body stands still
    float roll;                 // rad about the shaft, of what lies before kSpinEnd
};

// Where the numbers of a body begin.
constexpr int kPose = 0, kShaftOrigin = 12, kShaftDirection = 15, kSpinEnd = 18, kGateStart = 19, kGateWidth = 20, kLongest = 21,
              kBodyNumbers = 22;
// and of a joint
constexpr int kOrigin = 0, kAxis = 3, kValues = 6, kMostJoints = 31, kMostLinks = 32;
inline int joint_numbers(int links) { return kValues + links - 1; }

// Of all Gaussians; as gradients, dL/d of what goes into or comes out of posing.
struct PosedRows {
    float* means;
    float* quats;
    float* scales;              // gradients: of log_scales where they go in
    float* frames;              // world_from_sh; no gradient
    float* logits;              // gradients only
};

// Gaussians from a camera, and how much of each the training frames saw from each of some directions.
constexpr int kViewDirections = 12;
struct ViewInputs {
    int count;
    const float* means;         // [N, 3] mm, world
    const float* frames;        // [N, 4] unit, world_from_sh, or null
    const float* visibility;    // [N, 12]
    const float* directions;    // [12, 3] unit, in the frames
    float centre[3];            // of the camera, world, mm
    float half;                 // visibility of what is half unobserved
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
    // maps: room for three of [H, W]
    CastMaps (*cast)(const CastInputs&, Buffer<float>& work, float* maps, bool slope, float* shares);
    void (*cast_backward)(const CastInputs&, const CastMaps&, const float* shares, const float* gradient, Buffer<double>& partial,
                          float* to);
    void (*pose)(const Body&, const PosedRows&);
    void (*pose_backward)(const Body&, const PosedRows& from, const PosedRows& to, Buffer<double>& partial, float* to_numbers);
    // chosen: [N]; of the frame that was drawn last, whose alpha and depth [H, W] are given
    void (*composite_alone)(Frame&, const bool* chosen, const float* drawn_alpha, const float* drawn_depth, float* alpha, float* depth);
    void (*unobserved)(const ViewInputs&, float* to);  // [N]
};

// The table for this machine, or the one NEECO_SIMD asks for; throws std::runtime_error when that cannot run here.
const Kernels& kernels();

// Names this build holds and this machine can run, widest last.
std::vector<const char*> runnable_kernels();

// Chooses by name ("" = the default) for the rest of the process.
void select_kernels(const char* name);

// Numbers of composited values that the kernels are compiled for: colour, depth and 0, 1, 2, 4, 8, 16, 32 channels.
#define NEECO_VALUES(X) X(4) X(5) X(6) X(8) X(9) X(12) X(20) X(36)
constexpr int kMostChannels = 32;

// Groups the pieces of a chunk that was just projected by band.
void group_by_band(Frame& frame, int chunk);

// Lists the visible Gaussians per tile, near to far (equal depths by index).
void list_per_tile(Frame& frame);

void draw(Frame& frame, const Kernels& k, const GaussianInputs& in, const Images& out, bool keep);
void draw_backward(Frame& frame, const Kernels& k, const GaussianInputs& in, const ImageGradients& from,
                   const GaussianGradients& to);

}  // namespace neeco
