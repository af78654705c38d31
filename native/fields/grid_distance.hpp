// Signed distances in the box of a regular grid, and beyond it.
#pragma once

#include <algorithm>
#include <cmath>
#include <limits>

#include "fields/grid_interpolation.hpp"

namespace splatpilot {

struct GridField {
  VoxelGrid grid;
  double upper_W[3];
  bool occupied_outside;

  // The interpolant; outside, minus the distance to the box, or NaN. The gradient, zero where that
  // is not finite, is written unless it is null.
  double distance(const double* p, double* gradient) const {
    double in_box[3], beyond[3];
    bool inside = true;
    for (int k = 0; k < 3; ++k) {
      const double lower = grid.lower_W[k], upper = upper_W[k];
      in_box[k] = p[k] < lower ? lower : p[k] > upper ? upper : p[k];
      beyond[k] = p[k] - in_box[k];
      inside = inside && p[k] == in_box[k];  // false also for NaN
    }
    if (!inside && !occupied_outside) {
      if (gradient) std::fill_n(gradient, 3, 0.0);
      return std::numeric_limits<double>::quiet_NaN();
    }
    Interpolant at = grid.interpolate(in_box);
    if (!inside) {
      const double away =
          std::sqrt(beyond[0] * beyond[0] + beyond[1] * beyond[1] + beyond[2] * beyond[2]);
      at.value -= away;
      for (int k = 0; k < 3; ++k) {
        at.gradient[k] = (beyond[k] == 0.0 ? at.gradient[k] : 0.0) - beyond[k] / away;
      }
    }
    const bool is_known = std::isfinite(at.value);  // not of points that are not finite
    for (int k = 0; gradient && k < 3; ++k) gradient[k] = is_known ? at.gradient[k] : 0.0;
    return at.value;
  }
};

}  // namespace splatpilot
