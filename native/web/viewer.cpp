// The rasteriser for a page: one scene of bodies with joints, posed and drawn into RGBA. A page gives every worker of its
// own the scene, and rows of the image to draw. Compiled to WebAssembly by `make viewer`; page/worker.js calls it.
#define NEECO_VARIANT wasm
#define NEECO_WIDTH 4
#include <cmath>

#include "kernels.hpp"
#include "kernels/cast.hpp"
#include "kernels/composite.hpp"
#include "kernels/project.hpp"
#include "parallel.hpp"

#define NEECO_EXPORT(name) __attribute__((export_name(#name)))

namespace neeco {
namespace {

constexpr int kMostInstruments = 8, kMostAxes = 8, kMostLamps = 3;  // axes: of one instrument
constexpr int kPoseFloats = 16, kAxisFloats = 8;  // [R|t] by rows and the rotation's quaternion; pivot, axis, reading, whether it slides
constexpr float kMargin15 = 0.15f;     // of the image: how far beyond it the projection is linearised where it stands

// The shadows of what moves on what stands still are those of neeco/raster/shadow.py.
constexpr float kResolution = 0.5f, kMargin = 0.15f;  // of the image's, and of its size to each side
constexpr float kGamma = 2.2f, kDarkest = 0.01f, kNearestLit = 1e-3f;

struct Lamp {
    float offset[3];  // mm, in the camera's frame
    float strength;   // share of the light
};

enum Show { kImage, kLabelsOverImage, kLabels, kDepth };

struct Page {
    int count = 0, tissue = 0, coefficients = 1, axes = 0, labels = 0;  // the first `tissue` Gaussians stand still
    float threshold = 0.5f, background = 0, shadow_width = 0;
    int lamps = 0;
    Lamp lamp[kMostLamps];
    float vignette[2];
    float state[kMostInstruments * (kPoseFloats + kMostAxes * kAxisFloats)];  // poses, then the axes of every instrument
    float matrix[12];                                                // world_from_camera
    Buffer<float> canonical_means, canonical_quats, scales, opacities, sh, falloff, shares, amounts;
    Buffer<int32_t> body;
    Buffer<float> means, quats, frames, gains, radii, plain;
    Buffer<float> color, alpha, depth, channels;
    Buffer<uint32_t> pixels;
    Buffer<int32_t> ids;
    Buffer<float> maps, work, missed;
    Frame frame, light_frame;
} page;

void composite(Frame& f, const Images& out, int channels, bool) {
    switch (f.values) {
#define NEECO_CASE(V) case V: return wasm::composite_values<V, false>(f, out, channels);
        NEECO_VALUES(NEECO_CASE)
#undef NEECO_CASE
    }
}

const Kernels table = {"wasm", wasm::W, wasm::kStrip, wasm::kTileHeight, wasm::project, composite, nullptr, nullptr, nullptr, nullptr};

void multiply(const float* p, const float* q, float* r) {
    r[0] = p[0] * q[0] - p[1] * q[1] - p[2] * q[2] - p[3] * q[3];
    r[1] = p[0] * q[1] + p[1] * q[0] + p[2] * q[3] - p[3] * q[2];
    r[2] = p[0] * q[2] - p[1] * q[3] + p[2] * q[0] + p[3] * q[1];
    r[3] = p[0] * q[3] + p[1] * q[2] - p[2] * q[1] + p[3] * q[0];
}

void turn_by(const float* turn, float* quat) {
    float product[4];
    multiply(turn, quat, product);
    std::memcpy(quat, product, sizeof product);
}

// A point p, the Gaussian's orientation r and the turn of its harmonics, about a joint by `angle` (Rodrigues).
// Moves a Gaussian by `amount` about an axis, rad, or along one that slides, mm.
void move(const float* pivot, float amount, float* p, float* r, float* turned) {
    if (pivot[7] != 0) {
        for (int k = 0; k < 3; k++) p[k] += amount * pivot[3 + k];
        return;
    }
    const float s = sinf(amount), c = cosf(amount), *axis = pivot + 3;
    const float d[3] = {p[0] - pivot[0], p[1] - pivot[1], p[2] - pivot[2]};
    const float dot = (d[0] * axis[0] + d[1] * axis[1] + d[2] * axis[2]) * (1 - c);
    p[0] = pivot[0] + d[0] * c + (axis[1] * d[2] - axis[2] * d[1]) * s + axis[0] * dot;
    p[1] = pivot[1] + d[1] * c + (axis[2] * d[0] - axis[0] * d[2]) * s + axis[1] * dot;
    p[2] = pivot[2] + d[2] * c + (axis[0] * d[1] - axis[1] * d[0]) * s + axis[2] * dot;
    const float half = sinf(amount / 2), turn[4] = {cosf(amount / 2), half * axis[0], half * axis[1], half * axis[2]};
    turn_by(turn, r);
    turn_by(turn, turned);
}

struct View {
    float fx, fy, cx, cy, nearest;
    int width, height;
};

// The camera of rows [from, to) of a view at `centre`, turned as `page.matrix` is.
Camera camera_of(const View& v, const float* centre, int from, int to) {
    Camera c;
    for (int i = 0; i < 3; i++) {
        double t = 0;
        for (int j = 0; j < 3; j++) {
            c.rotation[3 * i + j] = page.matrix[4 * j + i];
            c.depth_row[j] = page.matrix[4 * j + 2];
            t -= (double)page.matrix[4 * j + i] * centre[j];
        }
        c.translation[i] = (float)t, c.centre[i] = centre[i];
        if (i == 2) c.depth_row[3] = t;
    }
    c.fx = v.fx, c.fy = v.fy, c.cx = v.cx, c.cy = v.cy - from, c.width = v.width, c.height = to - from, c.nearest = v.nearest;
    const float wide = kMargin15 * v.width / v.fx, high = kMargin15 * v.height / v.fy;  // of the whole view, whatever the rows
    c.low_x = -v.cx / v.fx - wide, c.high_x = (v.width - v.cx) / v.fx + wide;
    c.low_y = -v.cy / v.fy - high, c.high_y = (v.height - v.cy) / v.fy + high;
    return c;
}

GaussianInputs gaussians(int first) {
    GaussianInputs in;
    in.count = page.count - first;
    in.means = page.means.data() + 3 * first, in.quats = page.quats.data() + 4 * first;
    in.scales = page.scales.data() + 3 * first, in.opacities = page.opacities.data() + first;
    return in;
}

// What the lamp's casters keep from the tissue is added to `missing` [tissue].
void cast(const Lamp& lamp, const View& v, float* missing) {
    const float* m = page.matrix;
    float centre[3];
    for (int i = 0; i < 3; i++)
        centre[i] = m[4 * i + 3] + m[4 * i] * lamp.offset[0] + m[4 * i + 1] * lamp.offset[1] + m[4 * i + 2] * lamp.offset[2];
    const float wide = kMargin * v.width, high = kMargin * v.height;
    const View seen = {v.fx * kResolution, v.fy * kResolution, (v.cx + wide) * kResolution, (v.cy + high) * kResolution, v.nearest,
                       std::max(1, (int)std::nearbyint(kResolution * (1 + 2 * kMargin) * v.width)),
                       std::max(1, (int)std::nearbyint(kResolution * (1 + 2 * kMargin) * v.height))};
    Frame& f = page.light_frame;
    f.camera = camera_of(seen, centre, 0, seen.height);
    GaussianInputs in = gaussians(page.tissue);
    in.sh = page.plain.data(), in.sh_count = 1;
    const size_t size = (size_t)seen.width * seen.height;
    const Images out = {page.color.reserve(3 * size), page.alpha.reserve(size), page.depth.reserve(size), nullptr,
                        page.radii.reserve(page.count), nullptr};
    draw(f, table, in, out, false);
    CastInputs in_light{};
    in_light.count = page.tissue, in_light.height = seen.height, in_light.width = seen.width;
    in_light.alpha = out.alpha, in_light.depth = out.depth, in_light.means = page.means.data();
    std::memcpy(in_light.rotation, f.camera.rotation, sizeof in_light.rotation);
    std::memcpy(in_light.centre, centre, sizeof in_light.centre);
    in_light.fx = seen.fx, in_light.fy = seen.fy, in_light.cx = seen.cx, in_light.cy = seen.cy;
    in_light.sigma = page.shadow_width * seen.fx, in_light.nearest = kNearestLit;
    float* shares = page.missed.reserve(page.tissue);
    wasm::cast(in_light, page.work, page.maps.reserve(3 * size), false, shares);
    for (int i = 0; i < page.tissue; i++) missing[i] += lamp.strength * shares[i];
}

uint32_t packed(const float* rgb) {
    uint32_t word = 0xff000000u;
    for (int k = 0; k < 3; k++) {
        const float x = rgb[k] + 0.5f;
        word |= (uint32_t)(x < 0 ? 0 : x > 255 ? 255 : x) << (8 * k);
    }
    return word;
}

// The label of a pixel whose composited label columns are `share`: the largest's number + 1, or 0 below the threshold.
int label_of(const float* share) {
    float total = 0, best = -1;
    int id = 0;
    for (int k = 0; k < page.labels; k++) {
        total += share[k];
        if (share[k] > best) best = share[k], id = k;
    }
    return total > page.threshold ? id + 1 : 0;
}

}  // namespace
}  // namespace neeco

using namespace neeco;

extern "C" {

NEECO_EXPORT(begin) void begin(int count, int tissue, int coefficients, int axes, int labels, int lamps) {
    if (count < 0 || tissue < 0 || tissue > count || axes < 0 || axes > kMostAxes || labels < 0 || labels > kMostChannels ||
        lamps < 0 || lamps > kMostLamps)
        refuse("a scene of that size");
    page.count = count, page.tissue = tissue, page.coefficients = coefficients, page.axes = axes;
    page.labels = labels, page.lamps = lamps;
    float* plain = page.plain.reserve(3 * (size_t)count);
    for (size_t i = 0; i < 3 * (size_t)count; i++) plain[i] = 0;
}

// Where to write: 0 means [N, 3], 1 quaternions [N, 4] wxyz, 2 scales [N, 3] mm, 3 opacities [N], 4 harmonics [N, K, 3], 5 falloff [N],
// 6 labels [N, L], 7 amounts [N, A, 2] (rad or mm at a reading of 0, and per unit of it), 8 bodies [N] (int32), 9 light: vignette [2], shadow
// width, background, label threshold, then offset [3] and strength of every lamp; 10 the state, 11 the camera.
NEECO_EXPORT(input) void* input(int which) {
    const size_t n = page.count;
    static float light[5 + 4 * kMostLamps];
    switch (which) {
        case 0: return page.canonical_means.reserve(3 * n);
        case 1: return page.canonical_quats.reserve(4 * n);
        case 2: return page.scales.reserve(3 * n);
        case 3: return page.opacities.reserve(n);
        case 4: return page.sh.reserve(3 * n * page.coefficients);
        case 5: return page.falloff.reserve(n);
        case 6: return page.shares.reserve(n * page.labels);
        case 7: return page.amounts.reserve(n * 2 * page.axes);
        case 8: return page.body.reserve(n);
        case 9: return light;
        case 10: return page.state;
        default: return page.matrix;
    }
}

NEECO_EXPORT(lit) void lit() {
    const float* light = static_cast<const float*>(input(9));
    page.vignette[0] = light[0], page.vignette[1] = light[1];
    page.shadow_width = light[2], page.background = light[3], page.threshold = light[4];
    for (int k = 0; k < page.lamps; k++)
        page.lamp[k] = {{light[5 + 4 * k], light[6 + 4 * k], light[7 + 4 * k]}, light[8 + 4 * k]};
}

// Poses the scene as the state says.
NEECO_EXPORT(pose) void pose() {
    const int n = page.count, axes = page.axes;
    float *means = page.means.reserve(3 * n), *quats = page.quats.reserve(4 * n), *frames = page.frames.reserve(4 * n);
    for (int i = 0; i < n; i++) {
        const int body = page.body.data()[i];
        float p[3], r[4], turned[4] = {1, 0, 0, 0};
        std::memcpy(p, page.canonical_means.data() + 3 * i, sizeof p);
        std::memcpy(r, page.canonical_quats.data() + 4 * i, sizeof r);
        if (body > 0 && body <= kMostInstruments) {
            const float* own = page.state + kMostInstruments * kPoseFloats + (body - 1) * kMostAxes * kAxisFloats;
            const float* amounts = page.amounts.data() + (size_t)i * 2 * axes;
            for (int a = 0; a < axes; a++, own += kAxisFloats) move(own, amounts[2 * a] + amounts[2 * a + 1] * own[6], p, r, turned);
            const float* b = page.state + kPoseFloats * (body - 1);
            const float world[3] = {b[0] * p[0] + b[1] * p[1] + b[2] * p[2] + b[3], b[4] * p[0] + b[5] * p[1] + b[6] * p[2] + b[7],
                                    b[8] * p[0] + b[9] * p[1] + b[10] * p[2] + b[11]};
            std::memcpy(p, world, sizeof p);
            turn_by(b + 12, r);
            turn_by(b + 12, turned);
        }
        std::memcpy(means + 3 * i, p, sizeof p);
        std::memcpy(quats + 4 * i, r, sizeof r);
        std::memcpy(frames + 4 * i, turned, sizeof turned);
    }
}

// Finds the shadows for a camera of this whole image, before its rows are drawn.
NEECO_EXPORT(shade) void shade(float fx, float fy, float cx, float cy, int width, int height, float nearest) {
    float* gains = page.gains.reserve(page.count);
    for (int i = 0; i < page.count; i++) gains[i] = 0;
    if (page.tissue > 0 && page.tissue < page.count)
        for (int k = 0; k < page.lamps; k++)
            if (page.lamp[k].strength > 0) cast(page.lamp[k], {fx, fy, cx, cy, nearest, width, height}, gains);
    for (int i = 0; i < page.count; i++) gains[i] = powf(std::max(1 - gains[i], kDarkest), 1 / kGamma);
}

// Draws rows [from, to) of the image; returns its pixels, RGBA. `show` as in Show; near_mm is white and far_mm black in kDepth.
NEECO_EXPORT(draw) uint32_t* draw_rows(float fx, float fy, float cx, float cy, int width, int height, int from, int to, float nearest,
                                       int show, float near_mm, float far_mm) {
    const float centre[3] = {page.matrix[3], page.matrix[7], page.matrix[11]};
    page.frame.camera = camera_of({fx, fy, cx, cy, nearest, width, height}, centre, from, to);
    const size_t size = (size_t)width * (to - from);
    GaussianInputs in = gaussians(0);
    in.sh = page.sh.data(), in.sh_count = page.coefficients, in.sh_frames = page.frames.data();
    in.falloff = page.falloff.data(), in.vignette = page.vignette, in.gains = page.gains.data();
    const bool labelled = page.labels > 0 && (show == kLabels || show == kLabelsOverImage);
    if (labelled) in.channels = page.shares.data(), in.channel_count = page.labels;
    const float background[3] = {page.background, page.background, page.background};
    const Images out = {page.color.reserve(3 * size), page.alpha.reserve(size), page.depth.reserve(size),
                        page.channels.reserve(size * (labelled ? page.labels : 1)), page.radii.reserve(page.count), background};
    draw(page.frame, table, in, out, false);
    uint32_t* pixels = page.pixels.reserve(size);
    int32_t* ids = page.ids.reserve(size);
    // Okabe and Ito's colours, told apart by those who see fewer
    static const float tints[8][3] = {{0, 114, 178}, {230, 159, 0}, {0, 158, 115}, {204, 121, 167}, {86, 180, 233}, {213, 94, 0}, {240, 228, 66}, {180, 180, 180}};
    for (size_t i = 0; i < size; i++) {
        float v[3];
        for (int k = 0; k < 3; k++) v[k] = out.color[3 * i + k] * 255.f;
        ids[i] = labelled ? label_of(out.channels + i * page.labels) : 0;
        if (show == kDepth) {
            v[0] = v[1] = v[2] = out.alpha[i] > 0.5f ? (far_mm - out.depth[i]) / (far_mm - near_mm) * 255.f : 0;
        } else if (show == kLabels || show == kLabelsOverImage) {
            const float mix = ids[i] == 0 ? 0.f : show == kLabels ? 1.f : 0.45f, keep = show == kLabels ? 0.f : 1 - mix;
            for (int k = 0; k < 3; k++) v[k] = v[k] * keep + (mix > 0 ? tints[(ids[i] - 1) % 8][k] * mix : 0);
        }
        pixels[i] = packed(v);
    }
    return pixels;
}

// Of what was drawn last: label ids (int32, where labels were shown), and depth (float32, mm).
NEECO_EXPORT(ids) int32_t* ids_at() { return page.ids.data(); }
NEECO_EXPORT(depths) float* depths_at() { return page.depth.data(); }

}
