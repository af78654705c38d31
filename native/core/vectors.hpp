// Vectors of three numbers, one at a time.
#pragma once

#include "core/packs.hpp"

namespace splatpilot::SIMD_LEVEL {

template <typename Real>
SP_INLINE Real maximum(Real a, Real b) {
  return a > b ? a : b;
}

// A NaN becomes `low`.
template <typename Real>
SP_INLINE Real clamp(Real a, Real low, Real high) {
  const Real b = a > low ? a : low;
  return b < high ? b : high;
}

SP_INLINE float dot(const float* a, const float* b) {
  return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
}

// In the order in which numpy's einsum adds on processors with AVX2.
SP_INLINE double dot(const double* a, const double* b) {
  return (a[0] * b[0] + a[2] * b[2]) + a[1] * b[1];
}

SP_INLINE float root(float a) { return __builtin_sqrtf(a); }
SP_INLINE double root(double a) { return __builtin_sqrt(a); }

SP_INLINE float magnitude(float a) { return __builtin_fabsf(a); }
SP_INLINE double magnitude(double a) { return __builtin_fabs(a); }
SP_INLINE float with_sign(float a, float sign) { return __builtin_copysignf(a, sign); }
SP_INLINE double with_sign(double a, double sign) { return __builtin_copysign(a, sign); }

template <typename Real>
SP_INLINE Real length(const Real* a) {
  return root(dot(a, a));
}

template <typename Real>
SP_INLINE void subtract(const Real* a, const Real* b, Real* difference) {
  for (int k = 0; k < 3; ++k) difference[k] = a[k] - b[k];
}

}  // namespace splatpilot::SIMD_LEVEL
