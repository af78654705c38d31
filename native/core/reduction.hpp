// Sums over the lanes of several packs at once.
#pragma once

#include "core/simd.hpp"

namespace splatpilot::SIMD_LEVEL {

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
