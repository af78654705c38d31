// A static scene, prepared once so that each frame has less to do.
#pragma once

#include <cstdint>
#include <vector>

#include "types.hpp"

namespace splatpilot {

// Gaussians in Morton order, so that neighbours in space are neighbours in memory and can be culled
// together; covariances as lower-triangular factors L with L L^T = R S^2 R^T, computed in double.
class BakedScene {
 public:
  explicit BakedScene(const GaussianArrays& gaussians);

  const BakedArrays& arrays() const { return arrays_; }

 private:
  void store_geometry(const GaussianArrays& g, const std::vector<uint32_t>& order);
  void store_colors(const GaussianArrays& g, const std::vector<uint32_t>& order);
  void store_bounds(const GaussianArrays& g, const std::vector<uint32_t>& order);

  std::vector<float> geometry_, colors_, bounds_;
  BakedArrays arrays_{};
};

}  // namespace splatpilot
