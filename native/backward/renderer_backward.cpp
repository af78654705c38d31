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

}  // namespace

// Every pair has a place of its own to write to, and a splat's pairs are added in the order of the
// tiles: the sums do not depend on the threads.
size_t Renderer::raster_backward(const Frame& frame, const ImageGradient& image,
                                 SplatGradient* gradients, float* means2d) {
  std::atomic<size_t> composited{0};
  const RasterInput input = raster_input(frame);
  const StageReader record{frame.later_stages.data(), frame.transmittance.data(),
                           frame.stages_done.data()};
  if (pair_gradients_.size() < frame.pairs.size()) pair_gradients_.resize(frame.pairs.size());
  pool_.for_each(frame.stages_done.size(), [&](size_t tile) {
    composited += kernels_.raster_tile_backward(input, record, image, static_cast<int>(tile),
                                                thread_scratch(), pair_gradients_.data());
  });
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
  return composited;
}

void Renderer::clear_chunk(const GaussianArrays& gaussians, size_t chunk,
                           const GaussianGradients& out) {
  const size_t begin = chunk * kChunkSize;
  const size_t end = std::min(gaussians.count, begin + kChunkSize);
  const auto clear = [&](float* values, size_t columns) {
    std::fill(values + columns * begin, values + columns * end, 0.0f);
  };
  if (out.overwrite) {
    clear(out.means, 3);
    clear(out.quats, 4);
    clear(out.scales, 3);
    clear(out.opacities, 1);
  }
  if (out.overwrite_colors) clear(out.colors, 3 * static_cast<size_t>(gaussians.sh_coefficients));
}

PoseSums Renderer::total(const std::vector<PoseSums>& parts) {
  PoseSums sums{};
  for (const PoseSums& part : parts) {
    for (size_t i = 0; i < std::size(sums.values); ++i) sums.values[i] += part.values[i];
  }
  return sums;
}

// A chunk's splats come from the chunk's Gaussians, so each task owns the rows it writes.
PoseSums Renderer::project_backward(const Frame& frame, const GaussianArrays& gaussians,
                                    const SplatGradient* gradients, const float* means2d,
                                    const GaussianGradients& out) {
  const std::vector<size_t> starts = frame.chunk_starts();
  std::vector<PoseSums> sums(starts.size());
  pool_.for_each(starts.size(), [&](size_t chunk) {
    clear_chunk(gaussians, chunk, out);
    kernels_.project_backward(gaussians, frame.camera, frame.splats.data() + chunk * kChunkSize,
                              frame.chunk_counts[chunk], gradients + starts[chunk],
                              means2d + 2 * starts[chunk], out, &sums[chunk]);
  });
  return total(sums);
}

}  // namespace splatpilot
