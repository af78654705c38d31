// exp2, log2 and the arctangent of packs.
#pragma once

#include "core/simd.hpp"

namespace splatpilot::SIMD_LEVEL {

// 2^x for -126 <= x <= 127, relative error below 2e-7 (minimax polynomial on [-1/2, 1/2]). Beyond
// that range the result is meaningless but raises nothing.
SP_INLINE F16 exp2(const F16& x) {
  // Adding 1.5 * 2^23 rounds to the nearest integer and leaves it in the low bits.
  const F16 shifted = x + F16(12582912.0f);
  const F16 f = x - (shifted - F16(12582912.0f));
  F16 p = F16(1.327647245e-3f);
  p = p * f + F16(9.675541300e-3f);
  p = p * f + F16(5.550713092e-2f);
  p = p * f + F16(2.402211972e-1f);
  p = p * f + F16(6.931469693e-1f);
  p = p * f + F16(1.000000072f);
  return float_from_bits(bits_of(p) + shift_left(bits_of(shifted), 23));
}

// log2(x) for normal x > 0, absolute error below 2e-7 times max(1, |log2 x|): the series of atanh
// about 1 for the mantissa, taken in [sqrt(1/2), sqrt(2)).
SP_INLINE F16 log2(const F16& x) {
  const int32_t sqrt_half = 0x3f3504f3;
  const I16 offset = bits_of(x) - sqrt_half;
  const I16 exponent = shift_right(offset, 23);
  I16 mantissa = offset & 0x007fffff;
  mantissa = mantissa - (-sqrt_half);
  const F16 m = float_from_bits(mantissa);
  const F16 s = (m - F16(1.0f)) / (m + F16(1.0f));
  const F16 s2 = s * s;
  F16 p = F16(0.320598898f);       // 2 / (9 ln 2)
  p = p * s2 + F16(0.412198583f);  // 2 / (7 ln 2)
  p = p * s2 + F16(0.577078016f);  // 2 / (5 ln 2)
  p = p * s2 + F16(0.961796694f);  // 2 / (3 ln 2)
  p = p * s2 + F16(2.885390082f);  // 2 / ln 2
  return p * s + to_float(exponent);
}

// atan(x) for x >= 0, relative error below 3e-7: a polynomial fitted to [0, 1], and the complement
// beyond.
SP_INLINE F16 arctangent(const F16& x) {
  const Mask16 beyond = x > F16(1.0f);
  const F16 t = min(x, F16(1.0f) / max(x, F16(1.0f)));
  const F16 s = t * t;
  F16 p = F16(2.834064298e-3f);
  p = p * s + F16(-1.600503050e-2f);
  p = p * s + F16(4.258760746e-2f);
  p = p * s + F16(-7.495445443e-2f);
  p = p * s + F16(1.063675410e-1f);
  p = p * s + F16(-1.420257051e-1f);
  p = p * s + F16(1.999248358e-1f);
  p = p * s + F16(-3.333306678e-1f);
  p = p * s + F16(9.999999842e-1f);
  const F16 angle = p * t;
  return angle + zero_unless(beyond, F16(1.5707963268f) - F16(2.0f) * angle);
}

}  // namespace splatpilot::SIMD_LEVEL
