// Distances and states of space in many worlds, each of analytic shapes or of a regular grid.
#pragma once

#include <algorithm>
#include <cmath>
#include <limits>
#include <vector>

#include "fields/grid_distance.hpp"
#include "fields/shape_distances.hpp"

namespace splatpilot {

// Those of `FieldState`.
enum FieldState : uint8_t { kFree, kOccupied, kUnknown, kOutside };

struct SpaceSample {
  double distance;  // [m]
  uint8_t state;
};

// Shapes within a box, in cells that know which shapes can be the nearest of their points.
class ShapeBox {
 public:
  ShapeBox(std::vector<double> rows, std::vector<uint8_t> kinds, const double* lower,
           const double* upper)
      : rows_(std::move(rows)), kinds_(std::move(kinds)) {
    double volume = 1.0;
    for (int k = 0; k < 3; ++k) {
      lower_[k] = lower[k];
      upper_[k] = upper[k];
      volume *= upper[k] - lower[k];
    }
    const double edge = std::max(0.25, std::cbrt(volume / kMaxCells));
    for (int k = 0; k < 3; ++k) {
      const double span = upper_[k] - lower_[k];
      shape_[k] = std::max<size_t>(1, static_cast<size_t>(span / edge));
      per_meter_[k] = static_cast<double>(shape_[k]) / span;
    }
    std::vector<uint32_t> all(kinds_.size()), block, near;
    for (size_t i = 0; i < all.size(); ++i) all[i] = static_cast<uint32_t>(i);
    std::vector<std::vector<uint32_t>> cells(shape_[0] * shape_[1] * shape_[2]);
    for (size_t x = 0; x < shape_[0]; x += kBlock) {
      for (size_t y = 0; y < shape_[1]; y += kBlock) {
        for (size_t z = 0; z < shape_[2]; z += kBlock) {
          select(x, y, z, kBlock, all, block);
          const size_t end[3] = {std::min(x + kBlock, shape_[0]), std::min(y + kBlock, shape_[1]),
                                 std::min(z + kBlock, shape_[2])};
          for (size_t i = x; i < end[0]; ++i) {
            for (size_t j = y; j < end[1]; ++j) {
              for (size_t k = z; k < end[2]; ++k) select(i, j, k, 1, block, cells[cell(i, j, k)]);
            }
          }
        }
      }
    }
    first_.push_back(0);
    for (const std::vector<uint32_t>& candidates : cells) {
      candidates_.insert(candidates_.end(), candidates.begin(), candidates.end());
      first_.push_back(static_cast<uint32_t>(candidates_.size()));
    }
  }

  // Writes the gradient of the distance unless it is null.
  SpaceSample sample(const double* p, double* gradient) const {
    if (gradient) std::fill_n(gradient, 3, 0.0);
    if (!contains(p)) return {std::numeric_limits<double>::quiet_NaN(), kOutside};
    size_t at[3];
    for (int k = 0; k < 3; ++k) {
      at[k] = std::min(shape_[k] - 1, static_cast<size_t>((p[k] - lower_[k]) * per_meter_[k]));
    }
    const size_t number = cell(at[0], at[1], at[2]);
    double min_distance = std::numeric_limits<double>::infinity();
    const uint32_t* nearest = nullptr;
    for (uint32_t i = first_[number]; i < first_[number + 1]; ++i) {
      const double d = distance(candidates_[i], p, nullptr);
      if (d < min_distance) {
        min_distance = d;
        nearest = &candidates_[i];
      }
    }
    if (gradient && nearest) distance(*nearest, p, gradient);
    return {min_distance, min_distance < 0.0 ? kOccupied : kFree};
  }

  // Checks that no shape is within `radius` of p, which has `moved` from a point at a distance.
  bool is_clear(const double* p, double distance, double moved, double radius) const {
    return distance - moved > std::max(radius, 0.0) + 1e-9 && contains(p);
  }

 private:
  static constexpr double kMaxCells = 32768.0;
  static constexpr size_t kBlock = 8;  // of cells along each axis, which share candidates

  size_t cell(size_t x, size_t y, size_t z) const { return (x * shape_[1] + y) * shape_[2] + z; }

  bool contains(const double* p) const {
    bool inside = true;
    for (int k = 0; k < 3; ++k) inside = inside && p[k] >= lower_[k] && p[k] <= upper_[k];
    return inside;
  }

  double distance(uint32_t shape, const double* p, double* gradient) const {
    const double* row = rows_.data() + shape * kShapeSize;
    return SIMD_LEVEL::shape_distance(kinds_[shape], row, p, gradient);
  }

  // Finds those among `shapes` that can be the nearest in the cells from (x, y, z) on: distances
  // are 1-Lipschitz, so within R of a center c none with d(c) > min d(c) + 2 R is.
  void select(size_t x, size_t y, size_t z, size_t count, const std::vector<uint32_t>& shapes,
              std::vector<uint32_t>& selected) const {
    const size_t at[3] = {x, y, z};
    double center[3], square = 0.0;
    for (int k = 0; k < 3; ++k) {
      const double edge = static_cast<double>(count) / per_meter_[k];
      center[k] = lower_[k] + static_cast<double>(at[k]) / per_meter_[k] + 0.5 * edge;
      square += edge * edge;
    }
    std::vector<double> distances(shapes.size());
    double limit = std::numeric_limits<double>::infinity();
    for (size_t i = 0; i < shapes.size(); ++i) {
      distances[i] = distance(shapes[i], center, nullptr);
      limit = std::min(limit, distances[i]);
    }
    limit += std::sqrt(square) + 1e-6;
    selected.clear();
    for (size_t i = 0; i < shapes.size(); ++i) {
      if (!(distances[i] > limit)) selected.push_back(shapes[i]);
    }
  }

  std::vector<double> rows_;
  std::vector<uint8_t> kinds_;
  double lower_[3], upper_[3], per_meter_[3];
  size_t shape_[3];
  std::vector<uint32_t> first_, candidates_;  // of cells
};

// A grid of distances and states, whose arrays others keep.
struct GridBox {
  GridField field;
  const uint8_t* states;

  SpaceSample sample(const double* p, double* gradient) const {
    bool inside = true;
    int64_t at = 0;
    for (int k = 0; k < 3; ++k) {
      const double lower = field.grid.lower_W[k];
      inside = inside && p[k] >= lower && p[k] <= field.upper_W[k];
      const double position = std::floor((p[k] - lower) / field.grid.voxel_size);
      const int64_t last = field.grid.shape[k] - 1;
      const int64_t voxel = position > 0.0 ? static_cast<int64_t>(std::min(position, 1e9)) : 0;
      at = at * field.grid.shape[k] + std::min(voxel, last);
    }
    return {field.distance(p, gradient), inside ? states[at] : uint8_t{kOutside}};
  }

  // Interpolants are steeper than distances.
  bool is_clear(const double*, double, double, double) const { return false; }
};

}  // namespace splatpilot
