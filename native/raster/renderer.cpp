#include "raster/renderer.hpp"

#include <algorithm>
#include <atomic>
#include <limits>
#include <numeric>

#include "core/dispatch.hpp"

namespace splatpilot {

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
  start(*frame, camera, keep);
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

bool Renderer::are_valid(const GaussianArrays& g, size_t color_floats) {
  constexpr float kMost = std::numeric_limits<float>::max();
  constexpr float kLeast = std::numeric_limits<float>::min();
  const size_t chunks = (g.count + kChunkSize - 1) / kChunkSize;
  std::atomic<bool> valid{true};
  pool_.for_each(chunks, [&](size_t chunk) {
    const size_t begin = chunk * kChunkSize;
    const size_t count = std::min(g.count - begin, size_t{kChunkSize});
    const size_t color_begin = color_floats * chunk / chunks;
    const size_t color_count = color_floats * (chunk + 1) / chunks - color_begin;
    if (!kernels_.all_within(g.means + 3 * begin, 3 * count, -kMost, kMost) ||
        !kernels_.all_normalizable(g.quats + 4 * begin, count) ||
        !kernels_.all_within(g.scales + 3 * begin, 3 * count, kLeast, kMost) ||
        !kernels_.all_within(g.opacities + begin, count, 0.0f, 1.0f) ||
        !kernels_.all_within(g.colors + color_begin, color_count, -kMost, kMost)) {
      valid.store(false, std::memory_order_relaxed);
    }
  });
  return valid;
}

}  // namespace splatpilot
