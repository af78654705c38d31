// Vectors of three floats, one at a time.
#pragma once

#include "core/simd.hpp"

namespace splatpilot::SIMD_LEVEL {

SP_INLINE float maximum(float a, float b) { return a > b ? a : b; }

// A NaN becomes `low`.
SP_INLINE float clamp(float a, float low, float high) {
  const float b = a > low ? a : low;
  return b < high ? b : high;
}

SP_INLINE float dot(const float* a, const float* b) {
  return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
}

SP_INLINE float length(const float* a) { return __builtin_sqrtf(dot(a, a)); }

SP_INLINE void subtract(const float* a, const float* b, float* difference) {
  for (int k = 0; k < 3; ++k) difference[k] = a[k] - b[k];
}

}  // namespace splatpilot::SIMD_LEVEL
