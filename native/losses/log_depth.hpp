// The mean absolute difference of the logarithms of two depth images.
#pragma once

#include "core/mathematics.hpp"
#include "losses/losses.hpp"

namespace splatpilot::SIMD_LEVEL {

static double log_depth(const LogDepthInput& in) {
  size_t valid_count = 0;
  for (size_t i = 0; i < in.count; ++i) {
    valid_count += in.depth[i] > in.epsilon && in.depth[i] < in.far;
  }
  const float scale = valid_count ? 1.0f / static_cast<float>(valid_count) : 0.0f;
  const float ln2 = 0.69314718056f;

  double sum = 0.0;
  for (size_t i = 0; i < in.count; i += kLanes) {
    const float *rendered = in.rendered + i, *depth = in.depth + i;
    const float* weights = in.weights ? in.weights + i : nullptr;
    const bool whole = i + kLanes <= in.count;
    float last[3][kLanes] = {};  // beyond the end, a depth of 0 is invalid
    if (!whole) {
      for (size_t k = 0; k < in.count - i; ++k) {
        last[0][k] = rendered[k];
        last[1][k] = depth[k];
        last[2][k] = weights ? weights[k] : 1.0f;
      }
      rendered = last[0];
      depth = last[1];
      weights = last[2];
    }
    const F16 d = load(rendered), truth = load(depth);
    const F16 weight = weights ? load(weights) : F16(1.0f);
    const Mask16 valid = (truth > F16(in.epsilon)) & (truth < F16(in.far));
    const F16 at_least = max(F16(in.epsilon), d);
    const F16 difference = log2(at_least / truth) * F16(ln2);
    // log2 hides NaN and infinity; of both, x - x is NaN.
    const F16 loss = weight * max(difference, -difference) + (d - d);
    float values[kLanes];
    store(values, zero_unless(valid, loss));
    for (int k = 0; k < kLanes; ++k) sum += values[k];
    if (!in.gradient) continue;
    const F16 slope = weight * F16(scale) / at_least;
    const Mask16 moves = valid & (d > F16(in.epsilon));
    const F16 gradient =
        zero_unless(moves & (d > truth), slope) - zero_unless(moves & (d < truth), slope);
    if (whole) {
      store(in.gradient + i, gradient);
    } else {
      store(values, gradient);
      for (size_t k = 0; k < in.count - i; ++k) in.gradient[i + k] = values[k];
    }
  }
  return valid_count ? sum / static_cast<double>(valid_count) : 0.0;
}

}  // namespace splatpilot::SIMD_LEVEL
