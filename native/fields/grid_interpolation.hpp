// Trilinear interpolation between the voxel centers of a grid, in double precision.
#pragma once

#include <algorithm>
#include <cstdint>

#include "fields/trilinear.hpp"

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
  Interpolant interpolate(const double* p) const {
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
    Interpolant result;
    result.value = trilinear<double>(values + at, strides[0], strides[1], f, result.gradient);
    for (double& slope : result.gradient) slope /= voxel_size;
    return result;
  }
};

}  // namespace splatpilot
