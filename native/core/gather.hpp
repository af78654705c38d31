// Packs of integers as indices.
#pragma once

#include "core/simd.hpp"

namespace splatpilot::SIMD_LEVEL {

SP_INLINE I16 multiply(const I16& a, int32_t b) {
  I16 c;
  SP_EACH_REGISTER(k) c.r[k] = a.r[k] * b;
  return c;
}

// The floats at p, by their index.
SP_INLINE F16 gather(const float* p, const I16& index) {
  F16 a;
#if defined(__AVX512F__)
  a.r[0] = _mm512_i32gather_ps(reinterpret_cast<__m512i>(index.r[0]), p, 4);
#elif defined(__AVX2__)
  SP_EACH_REGISTER(k) {
    a.r[k] = _mm256_i32gather_ps(p, reinterpret_cast<__m256i>(index.r[k]), 4);
  }
#else
  SP_EACH_REGISTER(k) {
    for (int i = 0; i < kRegisterLanes; ++i) a.r[k][i] = p[index.r[k][i]];
  }
#endif
  return a;
}

}  // namespace splatpilot::SIMD_LEVEL
