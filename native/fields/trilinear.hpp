// Trilinear interpolation of a regular grid, last axis fastest.
#pragma once

#include <cstddef>

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

}  // namespace splatpilot
