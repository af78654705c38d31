// Packs of 16 numbers, and truth values for each of their lanes.
#pragma once

#include "core/packs.hpp"

namespace splatpilot::SIMD_LEVEL {

// A truth value per lane. AVX-512 has mask registers; elsewhere a lane is all ones or all zeros.
struct Mask16 {
#if defined(__AVX512F__)
  __mmask16 bits;
#else
  IntRegister r[kRegisters];
#endif
};

#if defined(__AVX512F__)
#define SP_COMPARE(name, op, predicate)                     \
  SP_INLINE Mask16 name(const F16& a, const F16& b) {       \
    return {_mm512_cmp_ps_mask(a.r[0], b.r[0], predicate)}; \
  }
#else
#define SP_COMPARE(name, op, predicate)               \
  SP_INLINE Mask16 name(const F16& a, const F16& b) { \
    Mask16 m;                                         \
    SP_EACH_REGISTER(k) m.r[k] = a.r[k] op b.r[k];    \
    return m;                                         \
  }
#endif
SP_COMPARE(operator>, >, _CMP_GT_OQ)
SP_COMPARE(operator>=, >=, _CMP_GE_OQ)
SP_COMPARE(operator<, <, _CMP_LT_OQ)
SP_COMPARE(operator<=, <=, _CMP_LE_OQ)
#undef SP_COMPARE

SP_INLINE Mask16 operator&(const Mask16& a, const Mask16& b) {
  Mask16 c;
#if defined(__AVX512F__)
  c.bits = static_cast<__mmask16>(a.bits & b.bits);
#else
  SP_EACH_REGISTER(k) c.r[k] = a.r[k] & b.r[k];
#endif
  return c;
}

SP_INLINE F16 zero_unless(const Mask16& m, const F16& a) {
  F16 c;
#if defined(__AVX512F__)
  c.r[0] = _mm512_maskz_mov_ps(m.bits, a.r[0]);
#else
  I16 b = bits_of(a);
  SP_EACH_REGISTER(k) b.r[k] &= m.r[k];
  c = float_from_bits(b);
#endif
  return c;
}

// Lane by lane, a where m is true, else b.
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

// The signs of the lanes, lane 0 lowest.
SP_INLINE uint32_t sign_bits(const I16& a) {
#if defined(__AVX512F__)
  return _mm512_movepi32_mask(reinterpret_cast<__m512i>(a.r[0]));
#else
  uint32_t bits = 0;
  SP_EACH_REGISTER(k) {
#if defined(__AVX2__)
    const int part = _mm256_movemask_ps(reinterpret_cast<__m256>(a.r[k]));
#elif defined(__SSE4_1__)
    const int part = _mm_movemask_ps(reinterpret_cast<__m128>(a.r[k]));
#elif defined(__ARM_NEON) && defined(__aarch64__)
    const int32x4_t weights = {1, 2, 4, 8};
    const int32x4_t signs = vshrq_n_s32(reinterpret_cast<int32x4_t>(a.r[k]), 31);
    const int part = vaddvq_s32(vandq_s32(signs, weights));
#else
    int part = 0;
    for (int i = 0; i < kRegisterLanes; ++i) part |= (a.r[k][i] < 0) << i;
#endif
    bits |= static_cast<uint32_t>(part) << (kRegisterLanes * k);
  }
  return bits;
#endif
}

// One bit per lane, lane 0 lowest.
SP_INLINE uint32_t lane_bits(const Mask16& m) {
#if defined(__AVX512F__)
  return m.bits;
#else
  I16 a;
  SP_EACH_REGISTER(k) a.r[k] = m.r[k];
  return sign_bits(a);
#endif
}

SP_INLINE bool any(const Mask16& m) {
#if defined(__AVX512F__)
  return m.bits != 0;
#else
  IntRegister either = m.r[0];
  for (int k = 1; k < kRegisters; ++k) either |= m.r[k];
#if defined(__AVX2__)
  return !_mm256_testz_si256(reinterpret_cast<__m256i>(either), reinterpret_cast<__m256i>(either));
#elif defined(__SSE4_1__)
  return !_mm_testz_si128(reinterpret_cast<__m128i>(either), reinterpret_cast<__m128i>(either));
#elif defined(__ARM_NEON) && defined(__aarch64__)
  return vmaxvq_u32(reinterpret_cast<uint32x4_t>(either)) != 0;
#else
  return (either[0] | either[1] | either[2] | either[3]) != 0;
#endif
#endif
}

}  // namespace splatpilot::SIMD_LEVEL
