// The backward half of Renderer.
#include <algorithm>
#include <atomic>
#include <memory>

#include "raster/renderer.hpp"

namespace splatpilot {
namespace {

struct alignas(64) Scratch {
  unsigned char bytes[kBackwardScratchBytes];
};

// On the heap: threads of some systems have small stacks.
Scratch* thread_scratch() {
  thread_local const std::unique_ptr<Scratch> scratch(new Scratch);
  return scratch.get();
}

// Rows [begin, end) of an array of `columns`.
void zero_rows(float* values, size_t columns, size_t begin, size_t end) {
  std::fill(values + columns * begin, values + columns * end, 0.0f);
}

}  // namespace

// Every pair has a place of its own to write to, and a splat's pairs are added in the order of the
// tiles: the sums do not depend on the threads.
size_t Renderer::raster_backward(const Frame& frame, const ImageGradient& image,
                                 SplatGradient* gradients, float* means2d) {
  std::atomic<size_t> composited{0};
  const RasterInput input = raster_input(frame);
  const StageReader record{frame.later_stages.data(), frame.transmittance.data(),
                           frame.stages_done.data()};
  lap();
  if (pair_gradients_.size() < frame.pairs.size()) pair_gradients_.resize(frame.pairs.size());
  pool_.for_each(frame.stages_done.size(), [&](size_t tile) {
    composited += kernels_.raster_tile_backward(input, record, image, static_cast<int>(tile),
                                                thread_scratch(), pair_gradients_.data());
  });
  seconds_.raster_backward = lap();
  const std::vector<size_t> starts = frame.chunk_starts();
  pool_.for_each(starts.size(), [&](size_t chunk) {
    const size_t first = chunk * kChunkSize;
    kernels_.gather_gradients(frame.splats.data() + first, frame.chunk_counts[chunk],
                              frame.ranges.data() + first, frame.slots.data(),
                              pair_gradients_.data(), gradients + starts[chunk]);
    for (size_t i = starts[chunk]; i < starts[chunk] + frame.chunk_counts[chunk]; ++i) {
      std::copy_n(gradients[i].mean, 2, means2d + 2 * i);
    }
  });
  seconds_.gather = lap();
  return composited;
}

// A chunk's splats come from the chunk's Gaussians, so each task owns the rows it writes.
PoseSums Renderer::project_backward(const Frame& frame, const GaussianArrays& gaussians,
                                    const SplatGradient* gradients, const float* means2d,
                                    const GaussianGradients& out) {
  lap();
  const std::vector<size_t> starts = frame.chunk_starts();
  std::vector<PoseSums> sums(starts.size());
  const size_t color_columns = 3 * static_cast<size_t>(gaussians.sh_coefficients);
  pool_.for_each(starts.size(), [&](size_t chunk) {
    const size_t begin = chunk * kChunkSize;
    const size_t end = std::min(gaussians.count, begin + kChunkSize);
    if (out.overwrite) {
      zero_rows(out.means, 3, begin, end);
      zero_rows(out.quats, 4, begin, end);
      zero_rows(out.scales, 3, begin, end);
      zero_rows(out.opacities, 1, begin, end);
    }
    if (out.overwrite_colors) zero_rows(out.colors, color_columns, begin, end);
    kernels_.project_backward(gaussians, frame.camera, frame.splats.data() + begin,
                              frame.chunk_counts[chunk], gradients + starts[chunk],
                              means2d + 2 * starts[chunk], out, &sums[chunk]);
  });
  PoseSums total{};
  for (const PoseSums& part : sums) {
    for (size_t i = 0; i < std::size(total.values); ++i) total.values[i] += part.values[i];
  }
  seconds_.project_backward = lap();
  return total;
}

}  // namespace splatpilot
