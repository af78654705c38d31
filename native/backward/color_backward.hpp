// From gradients of colors to those of what the input gives for them.
#pragma once

#include "backward/spherical_harmonics_backward.hpp"
#include "project/project_arrays.hpp"

namespace splatpilot::SIMD_LEVEL {

// Adds to rows of dL/dcolors and returns dL/d(p_W - center), which is zero without spherical
// harmonics. `color_gradient` is zero where a color is held at 0.
SP_INLINE Vector16 colors_backward(const GaussianArrays& g, const uint32_t* indices, int lanes,
                                   const Vector16& d_W, const F16 color_gradient[3],
                                   float* gradients) {
  alignas(64) float soa[48][kLanes];
  if (g.sh_degree < 0) {
    for (int c = 0; c < 3; ++c) store(soa[c], color_gradient[c]);
    for (int lane = 0; lane < lanes; ++lane) {
      float* row = gradients + 3 * static_cast<size_t>(indices[lane]);
      for (int c = 0; c < 3; ++c) row[c] += soa[c][lane];
    }
    return {F16(0.0f), F16(0.0f), F16(0.0f)};
  }
  const int used = 3 * (g.sh_degree + 1) * (g.sh_degree + 1);
  const size_t stride = 3 * static_cast<size_t>(g.sh_coefficients);
  prefetch_rows(gradients, static_cast<int>(stride), used, indices, (1u << lanes) - 1);
  for (int lane = 0; lane < kLanes; ++lane) {
    const float* row = g.colors + stride * indices[lane];
    for (int k = 0; k < used; ++k) soa[k][lane] = row[k];
  }
  F16 direction[3] = {F16(0.0f), F16(0.0f), F16(0.0f)};
  evaluate_sh_backward(g.sh_degree, soa[0], d_W.x, d_W.y, d_W.z, color_gradient, direction);
  for (int lane = 0; lane < lanes; ++lane) {
    float* row = gradients + stride * indices[lane];
    for (int k = 0; k < used; ++k) row[k] += soa[k][lane];
  }
  return {direction[0], direction[1], direction[2]};
}

}  // namespace splatpilot::SIMD_LEVEL
