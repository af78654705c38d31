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

  // Merges neighbors for cameras with a `merged_spread`, once: means and covariances by moments,
  // and opacities so that the covered area stays.
  void merge_neighbors();

  const BakedArrays& arrays() const { return arrays_; }

 private:
  struct Shape {
    std::vector<uint32_t> order;  // (count), indices in the input
    std::vector<float> geometry, bounds;
  };

  struct Merged {
    // Slots of each full box, halved along its widest axis again and again: a level merges runs.
    std::vector<uint32_t> slots;  // (boxes, kBoundSize)
    std::vector<double> areas;    // (boxes, kBoundSize), that the Gaussians cover
    std::vector<float> geometry, spreads;
  };

  static Shape pack_shape(const GaussianArrays& g);
  void store_colors(const float* colors, int sh_coefficients, int sh_degree);
  void merge_colors();

  std::shared_ptr<const Shape> shape_;
  std::shared_ptr<const Merged> merged_;
  std::vector<float> colors_, merged_colors_;
  BakedArrays arrays_{};
};

}  // namespace splatpilot
