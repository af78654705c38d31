// A frame of surfels: project, sort by depth, bin into tiles, composite; and the way back.
#pragma once

#include "renderer.hpp"
#include "surfel_types.hpp"

namespace splatpilot {

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
  // As Renderer::for_each_splat: visit(i, bounds, surfel).
  template <typename Visit>
  void for_each_surfel(const Visit& visit) {
    for_each_splat([&](size_t i, const Splat& bounds) {
      visit(i, bounds, surfels_[static_cast<size_t>(&bounds - frame_->splats.data())]);
    });
  }

 private:
  SurfelRasterInput raster_input();

  const SurfelKernels& surfel_kernels_;
  bool recorded_ = false;
  std::vector<Surfel> surfels_;
  std::vector<SurfelBlockRecord> records_;
  std::vector<uint32_t> pair_offsets_, pair_slots_;
  std::vector<SurfelGradient> pair_gradients_, surfel_gradients_;
};

}  // namespace splatpilot
