// What fits Gaussians to images beside rendering and losses: their parameters as they are
// optimised, and Adam. The table of these kernels exists once per SIMD level. Plain data only, as
// in types.hpp.
#pragma once

#include <cstddef>

namespace splatpilot {

struct AdamInput {
  float* parameters;
  const float* gradients;
  float *means, *squares;  // moving averages of the gradients and of their squares
  size_t count;
  float mean_decay, square_decay;
  float mean_share, square_share;  // 1 less the decays, which as floats lose what matters
  float rate;                      // learning rate / (1 - mean_decay^t)
  float square_scale;              // 1 / sqrt(1 - square_decay^t)
  float epsilon;
};

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
  void (*adam)(const AdamInput&);
  void (*shapes)(const ShapeInput&);
  void (*shapes_backward)(const ShapeGradientInput&);
};

}  // namespace splatpilot
