// exp2, log2 and arctangent of packs, and sums over their lanes.
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

// Halves of 128-bit lanes: (a0 + a2, a1 + a3, b0 + b2, b1 + b3) of each, then the sums of two such.
#if defined(__AVX512F__)
#define SP_SHUFFLE_LANES(a, b, i, j, k, l)                                                        \
  __builtin_shufflevector(a, b, i, j, 16 + k, 16 + l, 4 + i, 4 + j, 20 + k, 20 + l, 8 + i, 8 + j, \
                          24 + k, 24 + l, 12 + i, 12 + j, 28 + k, 28 + l)
#elif defined(__AVX2__)
#define SP_SHUFFLE_LANES(a, b, i, j, k, l) \
  __builtin_shufflevector(a, b, i, j, 8 + k, 8 + l, 4 + i, 4 + j, 12 + k, 12 + l)
#else
#define SP_SHUFFLE_LANES(a, b, i, j, k, l) __builtin_shufflevector(a, b, i, j, 4 + k, 4 + l)
#endif

SP_INLINE Register fold_halves(const Register& a, const Register& b) {
  return SP_SHUFFLE_LANES(a, b, 0, 1, 0, 1) + SP_SHUFFLE_LANES(a, b, 2, 3, 2, 3);
}

SP_INLINE Register fold_pairs(const Register& a, const Register& b) {
  return SP_SHUFFLE_LANES(a, b, 0, 2, 0, 2) + SP_SHUFFLE_LANES(a, b, 1, 3, 1, 3);
}
#undef SP_SHUFFLE_LANES

// sums[i] = the sum over the lanes of a[i]. The order of additions is fixed.
SP_INLINE void sum_lanes(const Register a[16], float sums[16]) {
  Register folded[kRegisters][4];
  for (int e = 0; e < 4; ++e) {
#if defined(__AVX512F__)
    // Of 128-bit lanes: (a0 + a2, a1 + a3, b0 + b2, b1 + b3), then whole sums (a, b, c, d).
    const auto half = [](const Register& p, const Register& q) {
      return _mm512_shuffle_f32x4(p, q, 0x44) + _mm512_shuffle_f32x4(p, q, 0xee);
    };
    const Register p = half(a[e], a[4 + e]), q = half(a[8 + e], a[12 + e]);
    folded[0][e] = _mm512_shuffle_f32x4(p, q, 0x88) + _mm512_shuffle_f32x4(p, q, 0xdd);
#elif defined(__AVX2__)
    for (int k = 0; k < kRegisters; ++k) {
      const Register &p = a[8 * k + e], &q = a[8 * k + 4 + e];
      folded[k][e] = _mm256_permute2f128_ps(p, q, 0x20) + _mm256_permute2f128_ps(p, q, 0x31);
    }
#else
    for (int k = 0; k < kRegisters; ++k) folded[k][e] = a[4 * k + e];
#endif
  }
  for (int k = 0; k < kRegisters; ++k) {
    const Register sum = fold_pairs(fold_halves(folded[k][0], folded[k][1]),
                                    fold_halves(folded[k][2], folded[k][3]));
    std::memcpy(sums + k * kRegisterLanes, &sum, kRegisterBytes);
  }
}

SP_INLINE void sum_lanes(const F16 a[16], float sums[16]) {
  Register whole[16];
  for (int i = 0; i < 16; ++i) {
    whole[i] = a[i].r[0];
    for (int k = 1; k < kRegisters; ++k) whole[i] += a[i].r[k];
  }
  sum_lanes(whole, sums);
}

}  // namespace splatpilot::SIMD_LEVEL
