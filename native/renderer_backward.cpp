// The backward half of Renderer.
#include <atomic>
#include <memory>

#include "renderer.hpp"

namespace flysplat {
namespace {

struct alignas(64) Scratch {
  unsigned char bytes[kBackwardScratchBytes];
};

// On the heap: threads of some systems have small stacks.
Scratch* thread_scratch() {
  thread_local const std::unique_ptr<Scratch> scratch(new Scratch);
  return scratch.get();
}

// Where each chunk's splats start in the order of the input.
std::vector<size_t> chunk_starts(const Frame& frame) {
  std::vector<size_t> starts(frame.chunk_counts.size());
  size_t sum = 0;
  for (size_t chunk = 0; chunk < starts.size(); ++chunk) {
    starts[chunk] = sum;
    sum += frame.chunk_counts[chunk];
  }
  return starts;
}

}  // namespace

// Every pair has a place of its own to write to, and a splat's pairs are added in the order of the
// tiles: the sums do not depend on the threads.
size_t Renderer::raster_backward(const Frame& frame, const ImageGradient& image,
                                 SplatGradient* gradients) {
  std::atomic<size_t> composited{0};
  RasterInput input = raster_input(frame);
  input.later_stages = frame.later_stages.data();
  input.transmittance = const_cast<float*>(frame.transmittance.data());
  input.stages_done = const_cast<uint32_t*>(frame.stages_done.data());
  if (pair_gradients_.size() < frame.pairs.size()) pair_gradients_.resize(frame.pairs.size());
  pool_.for_each(frame.stages_done.size(), [&](size_t tile) {
    composited += kernels_.raster_tile_backward(input, image, static_cast<int>(tile),
                                                thread_scratch(), pair_gradients_.data());
  });
  const std::vector<size_t> starts = chunk_starts(frame);
  pool_.for_each(starts.size(), [&](size_t chunk) {
    const size_t first = chunk * kChunkSize;
    kernels_.gather_gradients(frame.splats.data() + first, frame.chunk_counts[chunk],
                              frame.ranges.data() + first, frame.slots.data(),
                              pair_gradients_.data(), gradients + starts[chunk]);
  });
  return composited;
}

PoseSums Renderer::project_backward(const Frame& frame, const GaussianArrays& gaussians,
                                    const SplatGradient* gradients, const float* means2d,
                                    const GaussianGradients& out) {
  const std::vector<size_t> starts = chunk_starts(frame);
  std::vector<PoseSums> sums(starts.size());
  pool_.for_each(starts.size(), [&](size_t chunk) {
    kernels_.project_backward(gaussians, frame.camera, frame.splats.data() + chunk * kChunkSize,
                              frame.chunk_counts[chunk], gradients + starts[chunk],
                              means2d + 2 * starts[chunk], out, &sums[chunk]);
  });
  PoseSums total{};
  for (const PoseSums& part : sums) {
    for (size_t i = 0; i < std::size(total.values); ++i) total.values[i] += part.values[i];
  }
  return total;
}

}  // namespace flysplat
