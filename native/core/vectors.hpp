// Vectors of three numbers, of packs or one at a time, and rotations by quaternions.
#pragma once

#include "core/simd.hpp"

namespace splatpilot::SIMD_LEVEL {

template <typename T>
struct Vector3 {
  T x, y, z;
};
using Vector16 = Vector3<F16>;
using DoubleVector16 = Vector3<D16>;

template <typename T>
SP_INLINE Vector3<T> operator*(const T& s, const Vector3<T>& a) {
  return {s * a.x, s * a.y, s * a.z};
}
template <typename T>
SP_INLINE Vector3<T> operator+(const Vector3<T>& a, const Vector3<T>& b) {
  return {a.x + b.x, a.y + b.y, a.z + b.z};
}
template <typename T>
SP_INLINE Vector3<T> operator-(const Vector3<T>& a, const Vector3<T>& b) {
  return {a.x - b.x, a.y - b.y, a.z - b.z};
}
template <typename T>
SP_INLINE T dot(const Vector3<T>& a, const Vector3<T>& b) {
  return a.x * b.x + a.y * b.y + a.z * b.z;
}
template <typename T>
SP_INLINE T dot(const float a[3], const Vector3<T>& b) {
  return T(a[0]) * b.x + (T(a[1]) * b.y + T(a[2]) * b.z);
}
template <typename T>
SP_INLINE Vector3<T> cross(const Vector3<T>& a, const Vector3<T>& b) {
  return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
}

SP_INLINE float sqrt(float a) { return __builtin_sqrtf(a); }
SP_INLINE double sqrt(double a) { return __builtin_sqrt(a); }

// The columns of R(q), for q = (w, x, y, z) of any length but zero.
template <typename T>
SP_INLINE void rotation_columns(const T q[4], Vector3<T> columns[3]) {
  const T w = q[0], x = q[1], y = q[2], z = q[3], one = T(1.0f);
  const T two = T(2.0f) / (w * w + x * x + y * y + z * z);
  columns[0] = {one - two * (y * y + z * z), two * (x * y + w * z), two * (x * z - w * y)};
  columns[1] = {two * (x * y - w * z), one - two * (x * x + z * z), two * (y * z + w * x)};
  columns[2] = {two * (x * z + w * y), two * (y * z - w * x), one - two * (x * x + y * y)};
}

// From the gradients of these columns to that of q.
template <typename T>
SP_INLINE void quaternion_gradient(const T q[4], const Vector3<T>& c0, const Vector3<T>& c1,
                                   const Vector3<T>& c2, T dq[4]) {
  const T inverse_length = T(1.0f) / sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]);
  const T w = q[0] * inverse_length, x = q[1] * inverse_length, y = q[2] * inverse_length,
          z = q[3] * inverse_length;
  const T two = T(2.0f);
  const T d[4] = {
      two * (x * (c1.z - c2.y) + y * (c2.x - c0.z) + z * (c0.y - c1.x)),
      two * (y * (c1.x + c0.y) + z * (c2.x + c0.z) + w * (c1.z - c2.y) - two * x * (c1.y + c2.z)),
      two * (x * (c1.x + c0.y) + z * (c2.y + c1.z) + w * (c2.x - c0.z) - two * y * (c0.x + c2.z)),
      two * (x * (c2.x + c0.z) + y * (c2.y + c1.z) + w * (c0.y - c1.x) - two * z * (c0.x + c1.y))};
  const T radial = d[0] * w + d[1] * x + d[2] * y + d[3] * z;
  dq[0] = (d[0] - radial * w) * inverse_length;
  dq[1] = (d[1] - radial * x) * inverse_length;
  dq[2] = (d[2] - radial * y) * inverse_length;
  dq[3] = (d[3] - radial * z) * inverse_length;
}

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

// Added in the order of numpy's einsum on processors with AVX2.
SP_INLINE double dot(const double* a, const double* b) {
  return (a[0] * b[0] + a[2] * b[2]) + a[1] * b[1];
}

SP_INLINE float magnitude(float a) { return __builtin_fabsf(a); }
SP_INLINE double magnitude(double a) { return __builtin_fabs(a); }
SP_INLINE float with_sign(float a, float sign) { return __builtin_copysignf(a, sign); }
SP_INLINE double with_sign(double a, double sign) { return __builtin_copysign(a, sign); }

template <typename Real>
SP_INLINE Real length(const Real* a) {
  return sqrt(dot(a, a));
}

template <typename Real>
SP_INLINE void subtract(const Real* a, const Real* b, Real* difference) {
  for (int k = 0; k < 3; ++k) difference[k] = a[k] - b[k];
}

}  // namespace splatpilot::SIMD_LEVEL
