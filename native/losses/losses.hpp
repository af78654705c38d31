// Losses between a rendered image and the true one, value and gradient at once; the table of their
// kernels exists once per SIMD level. Plain data only, as in types.hpp.
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
  float* gradient;  // of the mean over valid pixels; null: not wanted
};

struct LossKernels {
  size_t (*photometric_scratch)(int width, int channels);
  PhotometricSums (*photometric)(const PhotometricInput&);
  // The mean over valid pixels of weight * |log(max(rendered, epsilon) / depth)|; 0 without any.
  double (*log_depth)(const LogDepthInput&);
};

}  // namespace splatpilot
