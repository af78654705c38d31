#include "surfels.hpp"

#include <algorithm>
#include <cstring>
#include <stdexcept>

#include "dispatch.hpp"

namespace splatpilot {
namespace {

const SurfelKernels& surfel_kernels(const Kernels& level) {
#if defined(__x86_64__)
  for (const auto table : {surfel_kernels_v2, surfel_kernels_v3, surfel_kernels_v4}) {
    if (std::strcmp(table().name, level.name) == 0) return table();
  }
  throw std::logic_error("no surfel kernels for this SIMD level");
#else
  return surfel_kernels_generic();
#endif
}

}  // namespace

SurfelRenderer::SurfelRenderer(int threads, const std::string& simd_level)
    : Renderer(threads, simd_level), surfel_kernels_(surfel_kernels(kernels())) {}

SurfelRasterInput SurfelRenderer::raster_input() {
  const int tiles_x = (frame_->camera.width + kTileSize - 1) / kTileSize;
  return {surfels_.data(),
          frame_->pairs.data(),
          frame_->tile_offsets.data(),
          frame_->camera.width,
          frame_->camera.height,
          tiles_x,
          frame_->camera.near_plane,
          recorded_ ? records_.data() : nullptr};
}

void SurfelRenderer::render(const GaussianArrays& gaussians, const Camera& camera,
                            const SurfelImages<float>& images, bool record) {
  start_frame(camera);
  recorded_ = record;
  if (surfels_.size() < gaussians.count) surfels_.resize(gaussians.count);
  project(gaussians.count, [&](size_t begin, size_t end, Splat* bounds, uint32_t* depth_bits) {
    return surfel_kernels_.project(gaussians, camera, begin, end, bounds, surfels_.data() + begin,
                                   depth_bits);
  });
  sort();
  const int tiles_x = (camera.width + kTileSize - 1) / kTileSize;
  const int tiles_y = (camera.height + kTileSize - 1) / kTileSize;
  const size_t tiles = static_cast<size_t>(tiles_x) * static_cast<size_t>(tiles_y);
  bin(surfel_kernels_.bin, tiles_x, tiles_y, false);
  if (record && records_.size() < tiles * kBlocksPerTile) records_.resize(tiles * kBlocksPerTile);
  const SurfelRasterInput input = raster_input();
  pool_.for_each(tiles, [&](size_t tile) {
    surfel_kernels_.raster_tile(input, images, static_cast<int>(tile));
  });
}

// Each tile writes the gradients of its pairs to slots in which the pairs of a surfel follow one
// another in the order of tiles; sums over slots then depend on nothing but the frame.
CameraGradient SurfelRenderer::backward(const GaussianArrays& gaussians,
                                        const SurfelImages<const float>& gradients,
                                        const InputGradients& out) {
  if (!recorded_) throw std::invalid_argument("the last frame was rendered without a record");
  pair_offsets_.assign(frame_->splats.size() + 1, 0);
  for (const Pair& pair : frame_->pairs) ++pair_offsets_[pair.splat + 1];
  for (size_t i = 0; i < frame_->splats.size(); ++i) pair_offsets_[i + 1] += pair_offsets_[i];
  pair_slots_.resize(frame_->pairs.size());
  pair_gradients_.resize(frame_->pairs.size());
  for (size_t i = 0; i < frame_->pairs.size(); ++i)
    pair_slots_[i] = pair_offsets_[frame_->pairs[i].splat]++;
  // The offsets have moved on by one splat.

  const SurfelRasterInput input = raster_input();
  pool_.for_each(frame_->tile_offsets.size() - 1, [&](size_t tile) {
    surfel_kernels_.raster_tile_backward(input, gradients, static_cast<int>(tile),
                                         pair_slots_.data(), pair_gradients_.data());
  });

  surfel_gradients_.resize(frame_->splats.size());
  std::vector<CameraGradient> by_chunk(frame_->chunk_counts.size());
  pool_.for_each(frame_->chunk_counts.size(), [&](size_t chunk) {
    const size_t first = chunk * kChunkSize, count = frame_->chunk_counts[chunk];
    std::vector<uint32_t> indices(count);
    for (size_t k = 0; k < count; ++k) {
      const size_t i = first + k;
      indices[k] = frame_->splats[i].index;
      float total[16] = {};
      for (uint32_t slot = i > 0 ? pair_offsets_[i - 1] : 0; slot < pair_offsets_[i]; ++slot) {
        float one[16];
        std::memcpy(one, &pair_gradients_[slot], sizeof(one));
        for (int f = 0; f < 16; ++f) total[f] += one[f];
      }
      std::memcpy(static_cast<void*>(&surfel_gradients_[i]), total, sizeof(total));
    }
    surfel_kernels_.project_backward(gaussians, frame_->camera, indices.data(),
                                     surfel_gradients_.data() + first, count, out,
                                     &by_chunk[chunk]);
  });
  CameraGradient by_camera{};
  for (const CameraGradient& part : by_chunk) {
    for (int k = 0; k < 9; ++k) by_camera.R[k] += part.R[k];
    for (int k = 0; k < 3; ++k) by_camera.t[k] += part.t[k];
    for (int k = 0; k < 3; ++k) by_camera.centre[k] += part.centre[k];
  }
  return by_camera;
}

}  // namespace splatpilot
