// Trilinear interpolation between the voxel centers of a grid, in double precision.
#pragma once

#include <algorithm>
#include <cstdint>

namespace splatpilot {

struct Interpolant {
  double value;
  double gradient[3];  // per meter
};

struct VoxelGrid {
  const float* values;
  int64_t shape[3];  // at least 2 voxels along each axis
  double lower_W[3];
  double voxel_size;

  // Beyond the outermost voxel centers the cell's polynomial is extrapolated.
  Interpolant interpolate(const double* p, bool with_gradient) const {
    double f[3];
    int64_t at = 0;
    const int64_t strides[3] = {shape[1] * shape[2], shape[2], 1};
    for (int k = 0; k < 3; ++k) {
      const double position = (p[k] - (lower_W[k] + 0.5 * voxel_size)) / voxel_size;
      // NaN stays in the fraction, in the first cell.
      const int64_t cell =
          position > 0.0 ? std::min(static_cast<int64_t>(position), shape[k] - 2) : 0;
      f[k] = position - static_cast<double>(cell);
      at += cell * strides[k];
    }
    double along_x[2][2], slope_x[2][2];  // by y and z
    for (int j = 0; j < 2; ++j) {
      for (int k = 0; k < 2; ++k) {
        const float* near = values + at + j * strides[1] + k;
        slope_x[j][k] = static_cast<double>(near[strides[0]]) - near[0];
        along_x[j][k] = near[0] + f[0] * slope_x[j][k];
      }
    }
    const auto mix = [](double a, double b, double part) { return a + part * (b - a); };
    const double low = mix(along_x[0][0], along_x[1][0], f[1]);
    const double high = mix(along_x[0][1], along_x[1][1], f[1]);
    Interpolant result{mix(low, high, f[2]), {}};
    if (with_gradient) {
      const double x = mix(mix(slope_x[0][0], slope_x[1][0], f[1]),
                           mix(slope_x[0][1], slope_x[1][1], f[1]), f[2]);
      const double y = mix(along_x[1][0] - along_x[0][0], along_x[1][1] - along_x[0][1], f[2]);
      const double slopes[3] = {x, y, high - low};
      for (int k = 0; k < 3; ++k) result.gradient[k] = slopes[k] / voxel_size;
    }
    return result;
  }
};

}  // namespace splatpilot
