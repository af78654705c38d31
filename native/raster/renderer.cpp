#include "raster/renderer.hpp"

#include <algorithm>
#include <atomic>
#include <limits>
#include <memory>
#include <numeric>

#include "core/dispatch.hpp"

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

size_t Frame::splat_count() const {
  return std::accumulate(chunk_counts.begin(), chunk_counts.end(), size_t{0});
}

std::vector<size_t> Frame::chunk_starts() const {
  std::vector<size_t> starts(chunk_counts.size());
  std::exclusive_scan(chunk_counts.begin(), chunk_counts.end(), starts.begin(), size_t{0});
  return starts;
}

Renderer::Renderer(int threads, const std::string& simd_level)
    : kernels_(splatpilot::kernels(simd_level)), pool_(threads) {}

std::shared_ptr<const Frame> Renderer::render(const GaussianArrays& gaussians, const Camera& camera,
                                              const Image& image, bool keep) {
  const auto project = [&](size_t begin, size_t end, Splat* splats, DepthPlane* planes,
                           uint32_t* depth_bits) {
    return kernels_.project(gaussians, camera, begin, end, splats, planes, depth_bits);
  };
  return draw(camera, image, keep, gaussians.count, project);
}

std::shared_ptr<const Frame> Renderer::render(const BakedArrays& scene,
                                              const GaussianArrays& moving, const Camera& camera,
                                              const Image& image) {
  const size_t baked = scene.groups * 16;
  // A chunk holds Gaussians of one kind.
  const size_t first_moving = (baked + kChunkSize - 1) / kChunkSize * kChunkSize;
  const auto project = [&](size_t begin, size_t end, Splat* splats, DepthPlane* planes,
                           uint32_t* depth_bits) {
    if (begin < baked) {
      return kernels_.project_baked(scene, camera, begin, std::min(end, baked), splats, planes,
                                    depth_bits);
    }
    return kernels_.project(moving, camera, begin - first_moving, end - first_moving, splats,
                            planes, depth_bits);
  };
  const size_t count = moving.count ? first_moving + moving.count : baked;
  return draw(camera, image, false, count, project);
}

std::shared_ptr<const Frame> Renderer::draw(const Camera& camera, const Image& image, bool keep,
                                            size_t count, const ProjectChunk& project) {
  const std::shared_ptr<Frame> frame = frames_.take();
  frame->camera = camera;
  frame->kept = keep;
  this->project(*frame, count, image.depth_mode == DepthMode::kMedian, project);
  sort(*frame);
  bin(*frame, kernels_.bin);
  composite(*frame, image);
  return frame;
}

void Renderer::composite(Frame& frame, const Image& image) {
  const RasterInput input = raster_input(frame);
  StageWriter record{};
  if (frame.kept) {
    const size_t tiles = frame.tiles();
    frame.later_stages.resize(tiles + 1);
    frame.stages_done.resize(tiles);
    size_t stages = 0;
    for (size_t tile = 0; tile < tiles; ++tile) {
      frame.later_stages[tile] = stages;
      const size_t count = frame.tile_offsets[tile + 1] - frame.tile_offsets[tile];
      stages += count > kStageSize ? (count - 1) / kStageSize : 0;
    }
    frame.later_stages[tiles] = stages;
    const size_t floats = stages * kTileSize * kTileSize;
    if (frame.transmittance.size() < floats) frame.transmittance.resize(floats);
    record = {frame.later_stages.data(), frame.transmittance.data(), frame.stages_done.data()};
  }
  pool_.for_each(frame.tiles(), [&](size_t tile) {
    kernels_.raster_tile(input, image, frame.kept ? &record : nullptr, static_cast<int>(tile));
  });
}

bool Renderer::are_valid(const GaussianArrays& g) {
  constexpr float kLargest = std::numeric_limits<float>::max();
  constexpr float kSmallest = std::numeric_limits<float>::min();
  const size_t chunks = (g.count + kChunkSize - 1) / kChunkSize;
  std::atomic<bool> valid{true};
  pool_.for_each(chunks, [&](size_t chunk) {
    const size_t begin = chunk * kChunkSize;
    const size_t count = std::min(g.count - begin, size_t{kChunkSize});
    const size_t colors = 3 * static_cast<size_t>(g.sh_coefficients);
    if (!kernels_.all_within(g.means + 3 * begin, 3 * count, -kLargest, kLargest) ||
        !kernels_.all_normalizable(g.quats + 4 * begin, count) ||
        !kernels_.all_within(g.scales + 3 * begin, 3 * count, kSmallest, kLargest) ||
        !kernels_.all_within(g.opacities + begin, count, 0.0f, 1.0f) ||
        !kernels_.all_within(g.colors + colors * begin, colors * count, -kLargest, kLargest)) {
      valid.store(false, std::memory_order_relaxed);
    }
  });
  return valid;
}

// Every pair is written separately, and a splat's pairs are added in the order of the tiles: the
// sums do not depend on the threads.
void Renderer::raster_backward(const Frame& frame, const ImageGradient& image,
                               SplatGradient* gradients, float* means2d) {
  const RasterInput input = raster_input(frame);
  const StageReader record{frame.later_stages.data(), frame.transmittance.data(),
                           frame.stages_done.data()};
  if (pair_gradients_.size() < frame.pairs.size()) pair_gradients_.resize(frame.pairs.size());
  pool_.for_each(frame.stages_done.size(), [&](size_t tile) {
    kernels_.raster_tile_backward(input, record, image, static_cast<int>(tile), thread_scratch(),
                                  pair_gradients_.data());
  });
  const std::vector<size_t> starts = frame.chunk_starts();
  pool_.for_each(starts.size(), [&](size_t chunk) {
    const size_t first = chunk * kChunkSize;
    kernels_.sum_pairs(frame.splats.data() + first, frame.chunk_counts[chunk],
                       frame.ranges.data() + first, frame.slots.data(), pair_gradients_.data(),
                       gradients + starts[chunk]);
    for (size_t i = starts[chunk]; i < starts[chunk] + frame.chunk_counts[chunk]; ++i) {
      std::copy_n(gradients[i].mean, 2, means2d + 2 * i);
    }
  });
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
