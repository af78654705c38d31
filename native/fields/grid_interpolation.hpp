// Trilinear interpolation between the voxel centers of a regular grid, last axis fastest.
#pragma once

#include <cstddef>
#include <cstdint>

namespace splatpilot {

// Returns the interpolant in the cell whose lowest corner is `near`, at fractions f of the cell;
// its gradient by f, unless null.
template <typename Real>
inline __attribute__((always_inline)) Real trilinear(const float* near, size_t layer, size_t row,
                                                     const Real f[3], Real* gradient) {
  const float* far = near + layer;
  Real step[2][2];   // by y and z
  Real along[2][2];  // interpolated along x
  for (size_t j = 0; j < 2; ++j) {
    for (size_t k = 0; k < 2; ++k) {
      const Real low = near[j * row + k];
      step[j][k] = far[j * row + k] - low;
      along[j][k] = low + f[0] * step[j][k];
    }
  }
  Real x[2], y[2], value[2];  // slopes and interpolants, by z
  for (int k = 0; k < 2; ++k) {
    x[k] = step[0][k] + f[1] * (step[1][k] - step[0][k]);
    y[k] = along[1][k] - along[0][k];
    value[k] = along[0][k] + f[1] * y[k];
  }
  if (gradient) {
    gradient[0] = x[0] + f[2] * (x[1] - x[0]);
    gradient[1] = y[0] + f[2] * (y[1] - y[0]);
    gradient[2] = value[1] - value[0];
  }
  return value[0] + f[2] * (value[1] - value[0]);
}

struct Interpolant {
  double value;
  double gradient[3];  // per meter
};

struct VoxelGrid {
  const float* values;
  int64_t shape[3];  // at least 2 voxels along each axis
  double lower_W[3];
  double voxel_size;

  // Extrapolates the cell's polynomial beyond the outermost voxel centers.
  Interpolant interpolate(const double* p) const {
    double f[3];
    int64_t at = 0;
    const int64_t strides[3] = {shape[1] * shape[2], shape[2], 1};
    for (int k = 0; k < 3; ++k) {
      const double position = (p[k] - (lower_W[k] + 0.5 * voxel_size)) / voxel_size;
      // NaN stays in the fraction, in the first cell.
      int64_t cell = position > 0.0 ? static_cast<int64_t>(position) : 0;
      if (cell > shape[k] - 2) cell = shape[k] - 2;
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
