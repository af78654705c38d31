// Lenses that bend what a pinhole would see: OpenCV's rational and fisheye models, 16 points at a
// time.
#pragma once

#include "core/mathematics.hpp"
#include "core/types.hpp"

namespace splatpilot::SIMD_LEVEL {

// Where a ray of slopes (x / z, y / z) meets the image plane of focal length 1, and the Jacobian
// by the slopes, which is symmetric in both models.
struct DistortedPoint {
  F16 x, y, xx, xy, yy;
};

SP_INLINE F16 polynomial3(const float k[3], const F16& s) {
  return F16(1.0f) + s * (F16(k[0]) + s * (F16(k[1]) + s * F16(k[2])));
}

// The derivative of polynomial3.
SP_INLINE F16 slope3(const float k[3], const F16& s) {
  return F16(k[0]) + s * (F16(2.0f * k[1]) + s * F16(3.0f * k[2]));
}

SP_INLINE DistortedPoint distort(const Distortion& lens, const F16& x, const F16& y) {
  const F16 s = x * x + y * y;
  F16 g, slope;  // (x', y') = g(s) (x, y), but for the tangential part, and dg/ds
  if (lens.model == DistortionModel::kFisheye) {
    // On the axis the quotients would be of zeros; so near it they are exact enough.
    const F16 safe = max(s, F16(1e-12f));
    const F16 r = sqrt(safe);
    const F16 angle = arctangent(r);
    const F16 a = angle * angle;
    const float* k = lens.radial;
    const F16 inverse_r = F16(1.0f) / r;
    g = angle * inverse_r *
        (F16(1.0f) + a * (F16(k[0]) + a * (F16(k[1]) + a * (F16(k[2]) + a * F16(k[3])))));
    const F16 growth =
        F16(1.0f) + a * (F16(3.0f * k[0]) +
                         a * (F16(5.0f * k[1]) + a * (F16(7.0f * k[2]) + a * F16(9.0f * k[3]))));
    slope = F16(0.5f) * inverse_r * inverse_r * (growth / (F16(1.0f) + safe) - g);
  } else {
    const F16 inverse = F16(1.0f) / polynomial3(lens.radial + 3, s);
    g = polynomial3(lens.radial, s) * inverse;
    slope = (slope3(lens.radial, s) - g * slope3(lens.radial + 3, s)) * inverse;
  }
  const F16 p1 = F16(lens.tangential[0]), p2 = F16(lens.tangential[1]);
  const F16 two = F16(2.0f), six = F16(6.0f);
  DistortedPoint out;
  out.x = g * x + (two * p1 * x * y + p2 * (s + two * x * x));
  out.y = g * y + (p1 * (s + two * y * y) + two * p2 * x * y);
  out.xx = g + two * x * x * slope + (two * p1 * y + six * p2 * x);
  out.xy = two * x * y * slope + (two * p1 * x + two * p2 * y);
  out.yy = g + two * y * y * slope + (six * p1 * y + two * p2 * x);
  return out;
}

// Whether rays have a place on the image: the lens does not fold the image back there.
SP_INLINE Mask16 has_place(const Distortion& lens, const F16& x, const F16& y,
                           const DistortedPoint& p) {
  return (F16(lens.most_squared_slope) > x * x + y * y) & (p.xx + p.yy > F16(0.0f)) &
         (p.xx * p.yy - p.xy * p.xy > F16(0.0f));
}

}  // namespace splatpilot::SIMD_LEVEL
