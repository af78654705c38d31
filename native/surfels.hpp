// A frame of surfels: project, sort by depth, bin into tiles, composite; and the way back.
#pragma once

#include "renderer.hpp"
#include "surfel_types.hpp"

namespace flysplat {

// As Renderer, and holds what the backward pass of the last frame needs. To keep a frame for later,
// keep its renderer.
class SurfelRenderer : public Renderer {
 public:
  SurfelRenderer(int threads, const std::string& simd_level);

  // `record`: a call of backward() follows.
  void render(const GaussianArrays& gaussians, const Camera& camera,
              const SurfelImages<float>& images, bool record);
  // Adds gradients of the last frame, of which `gaussians` must be the ones.
  CameraGradient backward(const GaussianArrays& gaussians,
                          const SurfelImages<const float>& gradients, const InputGradients& out);
  // Visits the surfels of the last frame in the order of the input.
  template <typename Visit>
  void for_each_surfel(const Visit& visit) const {
    if (!frame_) return;
    for (size_t chunk = 0; chunk < frame_->chunk_counts.size(); ++chunk) {
      const size_t first = chunk * kChunkSize;
      for (size_t i = first; i < first + frame_->chunk_counts[chunk]; ++i) {
        visit(frame_->splats[i], surfels_[i]);
      }
    }
  }

 private:
  SurfelRasterInput raster_input();

  const SurfelKernels& surfel_kernels_;
  bool recorded_ = false;
  std::vector<Surfel> surfels_;
  std::vector<BlockRecord> records_;
  std::vector<uint32_t> pair_offsets_, pair_slots_;
  std::vector<SurfelGradient> pair_gradients_, surfel_gradients_;
};

}  // namespace flysplat
