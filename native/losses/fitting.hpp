// Parameters of Gaussians as they are fitted; the table of these kernels exists once per SIMD
// level. Plain data only, as in types.hpp.
#pragma once

#include <cstddef>

namespace splatpilot {

// Shapes of n Gaussians; scales sqrt(exp(2 log_scale) + smallest^2) and opacities sigmoid(logit).
struct ShapeInput {
  size_t n;
  const float* log_scales;       // 3 n
  const float* logit_opacities;  // n
  const float* smallest;         // n
  float* scales;                 // 3 n
  float* opacities;              // n
};

struct ShapeGradientInput {
  size_t n;
  const float *scales, *opacities, *smallest;
  const float *v_scales, *v_opacities;
  float *v_log_scales, *v_logit_opacities;
};

struct FittingKernels {
  void (*shapes)(const ShapeInput&);
  void (*shapes_backward)(const ShapeGradientInput&);
};

}  // namespace splatpilot
