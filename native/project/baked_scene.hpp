// A static scene, prepared once for fast frames.
#pragma once

#include <cstdint>
#include <memory>
#include <vector>

#include "core/types.hpp"

namespace splatpilot {

// Gaussians in Morton order, so that neighbors in space are neighbors in memory and can be culled
// together; covariances as lower-triangular factors L with L L^T = R S^2 R^T, computed in double.
class BakedScene {
 public:
  explicit BakedScene(const GaussianArrays& gaussians);

  // The Gaussians of another scene, shared, in other colors (count, sh_coefficients, 3).
  BakedScene(const BakedScene& other, const float* colors, int sh_coefficients, int sh_degree);

  size_t count() const { return shape_->order.size(); }
  const BakedArrays& arrays() const { return arrays_; }

 private:
  struct Shape {
    std::vector<uint32_t> order;  // (count), indices in the input
    std::vector<float> geometry, bounds;
  };

  static Shape pack_shape(const GaussianArrays& g);
  void store_colors(const float* colors, int sh_coefficients, int sh_degree);

  std::shared_ptr<const Shape> shape_;
  std::vector<float> colors_;
  BakedArrays arrays_{};
};

}  // namespace splatpilot
