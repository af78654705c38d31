// Losses between rendered images and true ones, with gradients, and the parameters of Gaussians
// that minimize them. Plain data, as in types.hpp.
#pragma once

#include <cstddef>

namespace splatpilot {

// One image, rows of width * channels values in [0, 1].
struct PhotometricInput {
  const float* rendered;
  const float* target;
  int height, width, channels;
  // The gradient of l1_scale * sum |rendered - target| + ssim_scale * sum SSIM with respect to
  // `rendered` is written to `gradient`, unless that is null.
  float l1_scale, ssim_scale;
  float* gradient;
  float* scratch;  // photometric_scratch(width, channels) floats
};

struct PhotometricSums {
  double l1, dissimilarity;  // sums of |rendered - target| and 1 - SSIM over pixels and channels
};

// Pixels of depth [m], valid where epsilon < depth < far.
struct LogDepthInput {
  const float* rendered;
  const float* depth;
  const float* weights;  // null: all 1
  size_t count;
  float epsilon, far;
  float* gradient;  // of the mean over valid pixels; or null
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

struct LossKernels {
  size_t (*photometric_scratch)(int width, int channels);
  PhotometricSums (*photometric)(const PhotometricInput&);
  // The mean over valid pixels of weight * |log(max(rendered, epsilon) / depth)|; 0 without any.
  double (*log_depth)(const LogDepthInput&);
  void (*shapes)(const ShapeInput&);
  void (*shapes_backward)(const ShapeGradientInput&);
};

}  // namespace splatpilot
