// Choices and sums across lanes.
#pragma once

#include "simd.hpp"

namespace splatpilot::SIMD_LEVEL {

SP_INLINE F16 select(const Mask16& m, const F16& a, const F16& b) {
  F16 c;
#if defined(__AVX512F__)
  c.r[0] = _mm512_mask_mov_ps(b.r[0], m.bits, a.r[0]);
#else
  SP_EACH_REGISTER(k) {
    c.r[k] = reinterpret_cast<FloatRegister>((reinterpret_cast<IntRegister>(a.r[k]) & m.r[k]) |
                                             (reinterpret_cast<IntRegister>(b.r[k]) & ~m.r[k]));
  }
#endif
  return c;
}

// Sums of neighbours: those of a in the lower half, those of b in the upper.
SP_INLINE FloatRegister sum_neighbours(const FloatRegister& a, const FloatRegister& b) {
#if defined(__AVX512F__)
  return __builtin_shufflevector(a, b, 0, 2, 4, 6, 8, 10, 12, 14, 16, 18, 20, 22, 24, 26, 28, 30) +
         __builtin_shufflevector(a, b, 1, 3, 5, 7, 9, 11, 13, 15, 17, 19, 21, 23, 25, 27, 29, 31);
#elif defined(__AVX2__)
  return __builtin_shufflevector(a, b, 0, 2, 4, 6, 8, 10, 12, 14) +
         __builtin_shufflevector(a, b, 1, 3, 5, 7, 9, 11, 13, 15);
#else
  return __builtin_shufflevector(a, b, 0, 2, 4, 6) + __builtin_shufflevector(a, b, 1, 3, 5, 7);
#endif
}

// Lane k of the result is the sum of the lanes of packs[k].
SP_INLINE F16 lane_sums(const F16 packs[kLanes]) {
  FloatRegister r[kLanes];
  for (int i = 0; i < kLanes; ++i) {
    r[i] = packs[i].r[0];
    for (int k = 1; k < kRegisters; ++k) r[i] += packs[i].r[k];
  }
  for (int count = kLanes; count > kRegisters; count /= 2) {
    for (int i = 0; i < count / 2; ++i) r[i] = sum_neighbours(r[2 * i], r[2 * i + 1]);
  }
  F16 sums;
  SP_EACH_REGISTER(k) sums.r[k] = r[k];
  return sums;
}

}  // namespace splatpilot::SIMD_LEVEL
