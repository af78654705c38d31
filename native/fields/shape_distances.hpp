// Signed distances to the shapes of `splatpilot.systems.collision.shapes`. A gradient is written
// unless it is null.
#pragma once

#include "casting/ray_casting.hpp"
#include "core/vectors.hpp"

namespace splatpilot::SIMD_LEVEL {

SP_INLINE float hypotenuse(float a, float b) { return __builtin_sqrtf(a * a + b * b); }
SP_INLINE double hypotenuse(double a, double b) { return __builtin_hypot(a, b); }

// Normalizes a; a zero becomes a perpendicular to the unit vector `axis`.
template <typename Real>
SP_INLINE void write_direction(Real* a, const Real* axis, Real* gradient) {
  if (!gradient) return;
  Real size = length(a);
  if (size == Real(0)) {
    int smallest = 0;
    for (int k = 1; k < 3; ++k) {
      if (magnitude(axis[k]) < magnitude(axis[smallest])) smallest = k;
    }
    const int next = (smallest + 1) % 3, last = (smallest + 2) % 3;
    a[next] = axis[last];
    a[last] = -axis[next];
    size = length(a);
  }
  for (int k = 0; k < 3; ++k) gradient[k] = a[k] / size;
}

template <typename Real>
SP_INLINE Real sphere_distance(const Real* s, const Real* p, Real* gradient) {
  const Real up[3] = {0, 0, 1};
  Real away[3];
  subtract(p, s, away);
  const Real distance = length(away) - s[3];
  write_direction(away, up, gradient);
  return distance;
}

template <typename Real>
SP_INLINE Real capsule_distance(const Real* s, const Real* p, Real* gradient) {
  Real away[3];
  subtract(p, s, away);
  const Real along = clamp(dot(away, s + 3), Real(0), s[6]);
  for (int k = 0; k < 3; ++k) away[k] -= along * s[3 + k];
  const Real distance = length(away) - s[7];
  write_direction(away, s + 3, gradient);
  return distance;
}

template <typename Real>
SP_INLINE Real cylinder_distance(const Real* s, const Real* p, Real* gradient) {
  const Real* axis = s + 3;
  Real radial[3];
  subtract(p, s, radial);
  const Real along = dot(radial, axis);
  for (int k = 0; k < 3; ++k) radial[k] -= along * axis[k];
  const Real beyond_end = magnitude(along) - s[6], beyond_side = length(radial) - s[7];
  Real end = maximum(beyond_end, Real(0)), side = maximum(beyond_side, Real(0));
  const Real inner = maximum(beyond_end, beyond_side);
  const Real distance = inner > Real(0) ? hypotenuse(end, side) : inner;
  if (gradient) {
    if (!(inner > Real(0))) {
      end = beyond_end >= beyond_side ? 1 : 0;
      side = 1 - end;
    }
    const Real size = hypotenuse(end, side);
    write_direction(radial, axis, radial);
    end = with_sign(end, along);
    for (int k = 0; k < 3; ++k) gradient[k] = (end * axis[k] + side * radial[k]) / size;
  }
  return distance;
}

template <typename Real>
SP_INLINE Real box_distance(const Real* s, const Real* p, Real* gradient) {
  const Real *R = s + 3, *half = s + 12;
  Real m[3], local[3], beyond[3], excess[3];
  subtract(p, s, m);
  int deepest = 0;
  for (int k = 0; k < 3; ++k) {
    local[k] = m[0] * R[k] + m[1] * R[3 + k] + m[2] * R[6 + k];
    beyond[k] = magnitude(local[k]) - half[k];
    excess[k] = maximum(beyond[k], Real(0));
    if (beyond[k] > beyond[deepest]) deepest = k;
  }
  const bool outside = beyond[deepest] > Real(0);
  const Real distance =
      outside ? sqrt(excess[0] * excess[0] + excess[1] * excess[1] + excess[2] * excess[2])
              : beyond[deepest];
  if (gradient) {
    for (int k = 0; k < 3; ++k) {
      const Real w = outside ? excess[k] / distance : Real(k == deepest);
      excess[k] = with_sign(w, local[k]);
    }
    for (int k = 0; k < 3; ++k) {
      const Real* row = R + 3 * k;
      gradient[k] = row[0] * excess[0] + row[1] * excess[1] + row[2] * excess[2];
    }
  }
  return distance;
}

template <typename Real>
SP_INLINE Real half_space_distance(const Real* s, const Real* p, Real* gradient) {
  if (gradient) std::memcpy(gradient, s, 3 * sizeof(Real));
  return dot(p, s) - s[3];
}

template <typename Real>
SP_INLINE Real shape_distance(uint8_t kind, const Real* s, const Real* p, Real* gradient) {
  switch (kind) {
    case kSphere:
      return sphere_distance(s, p, gradient);
    case kCapsule:
      return capsule_distance(s, p, gradient);
    case kCylinder:
      return cylinder_distance(s, p, gradient);
    case kBox:
      return box_distance(s, p, gradient);
    default:
      return half_space_distance(s, p, gradient);
  }
}

}  // namespace splatpilot::SIMD_LEVEL
