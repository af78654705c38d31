// Packs of 16 doubles, for what must keep more digits than F16 has.
#pragma once

#include "core/simd.hpp"

namespace splatpilot::SIMD_LEVEL {

typedef double DoubleRegister __attribute__((vector_size(kRegisterBytes)));
typedef float HalfRegister __attribute__((vector_size(kRegisterBytes / 2)));
constexpr int kDoubleRegisters = 2 * kRegisters;

#define SP_EACH_DOUBLE(k) _Pragma("GCC unroll 8") for (int k = 0; k < kDoubleRegisters; ++k)

struct D16 {
  DoubleRegister r[kDoubleRegisters];

  D16() = default;
  SP_INLINE D16(double s) { SP_EACH_DOUBLE(k) r[k] = s - DoubleRegister{}; }
  SP_INLINE explicit D16(const F16& a) {
    alignas(64) float lanes[kLanes];
    store(lanes, a);
    SP_EACH_DOUBLE(k) {
      HalfRegister half;
      std::memcpy(&half, lanes + k * kRegisterLanes / 2, sizeof(half));
      r[k] = __builtin_convertvector(half, DoubleRegister);
    }
  }
};

// Rounded to nearest.
SP_INLINE F16 to_float(const D16& a) {
  alignas(64) float lanes[kLanes];
  SP_EACH_DOUBLE(k) {
    const HalfRegister half = __builtin_convertvector(a.r[k], HalfRegister);
    std::memcpy(lanes + k * kRegisterLanes / 2, &half, sizeof(half));
  }
  return load(lanes);
}

SP_ARITHMETIC(D16, SP_EACH_DOUBLE)
#undef SP_EACH_DOUBLE

}  // namespace splatpilot::SIMD_LEVEL
