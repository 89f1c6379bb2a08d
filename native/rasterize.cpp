// The stages in order, timed.
#include <algorithm>
#include <chrono>

#include "kernels.hpp"

namespace neeco {
namespace {

class Stopwatch {
public:
    double lap() {
        const auto now = std::chrono::steady_clock::now();
        const double ms = std::chrono::duration<double, std::milli>(now - last_).count();
        last_ = now;
        return ms;
    }

private:
    std::chrono::steady_clock::time_point last_ = std::chrono::steady_clock::now();
};

int padded_values(int wanted) {
#define NEECO_FITS(V) \
    if (wanted <= V) return V;
    NEECO_VALUES(NEECO_FITS)
#undef NEECO_FITS
    refuse("more than 32 channels");
}

void lay_out(Frame& f, const Kernels& k, const GaussianInputs& in) {
    f.count = in.count;
    f.values = padded_values(4 + in.channel_count);
    f.record_stride = (kRecordHead + f.values + 15) / 16 * 16;
    f.tile_width = k.tile_width;
    f.tile_height = k.tile_height;
    f.tiles_x = (f.camera.width + k.tile_width - 1) / k.tile_width;
    f.tiles_y = (f.camera.height + k.tile_height - 1) / k.tile_height;
    // Even numbers of bands, so that two threads share them well; about 16 columns, so that few Gaussians lie in two.
    f.bands = std::min({2 * ((f.tiles_x + 31) / 32), kMostBands, f.tiles_x});
    f.band_columns = (f.tiles_x + f.bands - 1) / f.bands;
    f.bands = (f.tiles_x + f.band_columns - 1) / f.band_columns;
    if (static_cast<int64_t>(f.tiles_x) * f.tiles_y >= int64_t{1} << kTileBits) refuse("image too large");
    const size_t pixels = static_cast<size_t>(f.camera.width) * f.camera.height, n = in.count;
    f.records.reserve(n * f.record_stride);
    f.spans.reserve(n);
    f.visible_list.reserve(n);
    f.transmittance.reserve(pixels);
    f.last.reserve(pixels);
    f.chunks.resize((n + kChunk - 1) / kChunk);
}

}  // namespace

void draw(Frame& f, const Kernels& k, const GaussianInputs& in, const Images& out, bool keep) {
    lay_out(f, k, in);
    Stopwatch watch;
    k.project(f, in, out.radii);
    f.milliseconds[kProject] = watch.lap();
    list_per_tile(f);
    f.milliseconds[kBin] = watch.lap();
    k.composite(f, out, in.channel_count, keep);
    f.milliseconds[kComposite] = watch.lap();
}

void draw_backward(Frame& f, const Kernels& k, const GaussianInputs& in, const ImageGradients& from, const GaussianGradients& to) {
    Stopwatch watch;
    k.composite_backward(f, from, in.channel_count);
    f.milliseconds[kCompositeBackward] = watch.lap();
    k.project_backward(f, in, to);
    f.milliseconds[kProjectBackward] = watch.lap();
}

}  // namespace neeco
