// Frames of surfels, and their backward pass.
#include <algorithm>
#include <cstring>

#include "raster/renderer.hpp"

namespace splatpilot {
namespace {

SurfelRasterInput raster_input(const SurfelFrame& frame) {
  const Frame& bounds = frame.bounds;
  return {frame.surfels.data(),    bounds.pairs.data(),  bounds.tile_offsets.data(),
          bounds.camera.width,     bounds.camera.height, bounds.tiles_x(),
          bounds.camera.near_plane};
}

}  // namespace

std::shared_ptr<const SurfelFrame> Renderer::render_surfels(const GaussianArrays& surfels,
                                                            const Camera& camera,
                                                            const SurfelImages<float>& images,
                                                            bool keep) {
  const SurfelKernels& kernels = *kernels_.surfels;
  const std::shared_ptr<SurfelFrame> frame = surfel_frames_.take();
  Frame& bounds = frame->bounds;
  bounds.camera = camera;
  bounds.kept = keep;
  if (frame->surfels.size() < surfels.count) frame->surfels.resize(surfels.count);
  project(bounds, surfels.count, false,
          [&](size_t begin, size_t end, Splat* splats, DepthPlane*, uint32_t* depth_bits) {
            return kernels.project(surfels, camera, begin, end, splats,
                                   frame->surfels.data() + begin, depth_bits);
          });
  sort(bounds);
  bin(bounds, kernels.bin);
  const size_t blocks = bounds.tiles() * kBlocksPerTile;
  if (keep && frame->records.size() < blocks) frame->records.resize(blocks);
  const SurfelRasterInput input = raster_input(*frame);
  pool_.for_each(bounds.tiles(), [&](size_t tile) {
    kernels.raster_tile(input, images, keep ? frame->records.data() : nullptr,
                        static_cast<int>(tile));
  });
  return frame;
}

// As for Gaussians, the sums do not depend on the threads.
PoseSums Renderer::surfels_backward(const SurfelFrame& frame, const GaussianArrays& surfels,
                                    const SurfelImages<const float>& gradients,
                                    const GaussianGradients& out) {
  const SurfelKernels& kernels = *kernels_.surfels;
  const Frame& bounds = frame.bounds;
  if (surfel_pair_gradients_.size() < bounds.pairs.size()) {
    surfel_pair_gradients_.resize(bounds.pairs.size());
  }
  const SurfelRasterInput input = raster_input(frame);
  pool_.for_each(bounds.tiles(), [&](size_t tile) {
    kernels.raster_tile_backward(input, frame.records.data(), gradients, static_cast<int>(tile),
                                 surfel_pair_gradients_.data());
  });

  std::vector<PoseSums> pose_sums(bounds.chunk_counts.size());
  pool_.for_each(pose_sums.size(), [&](size_t chunk) {
    clear_chunk(surfels, chunk, out);
    const size_t first = chunk * kChunkSize, count = bounds.chunk_counts[chunk];
    std::vector<uint32_t> indices(count);
    std::vector<SurfelGradient> sums(count);
    for (size_t i = 0; i < count; ++i) {
      indices[i] = bounds.splats[first + i].index;
      const PairRange& range = bounds.ranges[first + i];
      float total[16] = {};
      for (uint32_t k = range.begin; k < range.end; ++k) {
        float one[16];
        std::memcpy(one, &surfel_pair_gradients_[bounds.slots[k]], sizeof(one));
        for (int f = 0; f < 16; ++f) total[f] += one[f];
      }
      std::memcpy(static_cast<void*>(&sums[i]), total, sizeof(total));
    }
    kernels.project_backward(surfels, bounds.camera, indices.data(), sums.data(), count, out,
                             &pose_sums[chunk]);
  });
  return total(pose_sums);
}

}  // namespace splatpilot
