// Packs of 16 floats or 32-bit integers: one AVX-512 register, two of AVX or four of SSE or NEON.
//
// Every kernel is written once in terms of these packs and compiled once per SIMD level, each time
// inside its own namespace SIMD_LEVEL. Kernel code must use nothing from the standard library
// that could be emitted out of line: the linker would be free to keep the copy with the widest
// instructions and call it on a machine that lacks them.
#pragma once

#include <cstdint>
#include <cstring>

#if defined(__AVX512F__) || defined(__AVX2__) || defined(__SSE4_1__)
#include <immintrin.h>
#elif defined(__ARM_NEON)
#include <arm_neon.h>
#endif

#define SP_INLINE inline __attribute__((always_inline))
#define SP_EACH_OF(count, k) _Pragma("GCC unroll 4") for (int k = 0; k < (count); ++k)
#define SP_EACH_REGISTER(k) SP_EACH_OF(kRegisters, k)

// An operator on packs, register by register as `each` loops over k.
#define SP_BINARY(Pack, each, op)                            \
  SP_INLINE Pack operator op(const Pack& a, const Pack& b) { \
    Pack c;                                                  \
    each(k) c.r[k] = a.r[k] op b.r[k];                       \
    return c;                                                \
  }
#define SP_ARITHMETIC(Pack, each) \
  SP_BINARY(Pack, each, +)        \
  SP_BINARY(Pack, each, -)        \
  SP_BINARY(Pack, each, *)        \
  SP_BINARY(Pack, each, /)

namespace splatpilot::SIMD_LEVEL {

constexpr int kLanes = 16;
#if defined(__AVX512F__)
constexpr int kRegisterBytes = 64;
#elif defined(__AVX2__)
constexpr int kRegisterBytes = 32;
#else
constexpr int kRegisterBytes = 16;
#endif
constexpr int kRegisters = 64 / kRegisterBytes;
constexpr int kRegisterLanes = kRegisterBytes / 4;

typedef float FloatRegister __attribute__((vector_size(kRegisterBytes)));
typedef int32_t IntRegister __attribute__((vector_size(kRegisterBytes)));
typedef uint32_t UnsignedRegister __attribute__((vector_size(kRegisterBytes)));

struct F16 {
  FloatRegister r[kRegisters];

  F16() = default;
  SP_INLINE F16(float s) {
    SP_EACH_REGISTER(k) r[k] = s - FloatRegister{};
  }
};

struct I16 {
  IntRegister r[kRegisters];
};

// Register by register: of a copy of the whole, GCC makes one through memory in small pieces.
SP_INLINE F16 load(const float* p) {
  F16 a;
  SP_EACH_REGISTER(k) std::memcpy(&a.r[k], p + k * kRegisterLanes, kRegisterBytes);
  return a;
}

SP_INLINE I16 load(const int32_t* p) {
  I16 a;
  SP_EACH_REGISTER(k) std::memcpy(&a.r[k], p + k * kRegisterLanes, kRegisterBytes);
  return a;
}

SP_INLINE void store(float* p, const F16& a) {
  SP_EACH_REGISTER(k) std::memcpy(p + k * kRegisterLanes, &a.r[k], kRegisterBytes);
}

// The first `count` values at p, zeros after them.
SP_INLINE F16 load_first(const float* p, size_t count) {
  if (count >= kLanes) return load(p);
  float values[kLanes] = {};
  for (size_t k = 0; k < count; ++k) values[k] = p[k];
  return load(values);
}

SP_INLINE void store_first(float* p, const F16& a, size_t count) {
  if (count >= kLanes) return store(p, a);
  float values[kLanes];
  store(values, a);
  for (size_t k = 0; k < count; ++k) p[k] = values[k];
}

SP_ARITHMETIC(F16, SP_EACH_REGISTER)

SP_INLINE F16 operator-(const F16& a) {
  F16 c;
  SP_EACH_REGISTER(k) c.r[k] = -a.r[k];
  return c;
}

SP_INLINE F16& operator+=(F16& a, const F16& b) { return a = a + b; }

using Register = FloatRegister;
#if defined(__AVX512F__)
SP_INLINE Register register_min(Register a, Register b) { return _mm512_min_ps(a, b); }
SP_INLINE Register register_max(Register a, Register b) { return _mm512_max_ps(a, b); }
SP_INLINE Register register_sqrt(Register a) { return _mm512_sqrt_ps(a); }
#elif defined(__AVX2__)
SP_INLINE Register register_min(Register a, Register b) { return _mm256_min_ps(a, b); }
SP_INLINE Register register_max(Register a, Register b) { return _mm256_max_ps(a, b); }
SP_INLINE Register register_sqrt(Register a) { return _mm256_sqrt_ps(a); }
#elif defined(__SSE4_1__)
SP_INLINE Register register_min(Register a, Register b) { return _mm_min_ps(a, b); }
SP_INLINE Register register_max(Register a, Register b) { return _mm_max_ps(a, b); }
SP_INLINE Register register_sqrt(Register a) { return _mm_sqrt_ps(a); }
#else
SP_INLINE Register register_min(Register a, Register b) { return a < b ? a : b; }
SP_INLINE Register register_max(Register a, Register b) { return a > b ? a : b; }
SP_INLINE Register register_sqrt(Register a) {
  for (int i = 0; i < kRegisterLanes; ++i) a[i] = __builtin_sqrtf(a[i]);
  return a;
}
#endif

// Of an unordered pair both return the second operand, as the x86 instructions do.
SP_INLINE F16 min(const F16& a, const F16& b) {
  F16 c;
  SP_EACH_REGISTER(k) c.r[k] = register_min(a.r[k], b.r[k]);
  return c;
}

SP_INLINE F16 max(const F16& a, const F16& b) {
  F16 c;
  SP_EACH_REGISTER(k) c.r[k] = register_max(a.r[k], b.r[k]);
  return c;
}

SP_INLINE F16 clamp(const F16& a, const F16& low, const F16& high) {
  return min(max(a, low), high);
}

SP_INLINE F16 sqrt(const F16& a) {
  F16 c;
  SP_EACH_REGISTER(k) c.r[k] = register_sqrt(a.r[k]);
  return c;
}

SP_INLINE I16 bits_of(const F16& a) {
  I16 b;
  SP_EACH_REGISTER(k) b.r[k] = reinterpret_cast<IntRegister>(a.r[k]);
  return b;
}

SP_INLINE F16 float_from_bits(const I16& a) {
  F16 b;
  SP_EACH_REGISTER(k) b.r[k] = reinterpret_cast<FloatRegister>(a.r[k]);
  return b;
}

// Wraps around.
SP_INLINE I16 operator+(const I16& a, const I16& b) {
  I16 c;
  SP_EACH_REGISTER(k) {
    c.r[k] = reinterpret_cast<IntRegister>(reinterpret_cast<UnsignedRegister>(a.r[k]) +
                                           reinterpret_cast<UnsignedRegister>(b.r[k]));
  }
  return c;
}

SP_INLINE I16 operator-(const I16& a, int32_t b) {
  I16 c;
  SP_EACH_REGISTER(k) {
    c.r[k] = reinterpret_cast<IntRegister>(reinterpret_cast<UnsignedRegister>(a.r[k]) -
                                           static_cast<uint32_t>(b));
  }
  return c;
}

SP_INLINE I16 operator&(const I16& a, int32_t b) {
  I16 c;
  SP_EACH_REGISTER(k) c.r[k] = a.r[k] & b;
  return c;
}

SP_INLINE I16 shift_left(const I16& a, int n) {
  I16 c;
  SP_EACH_REGISTER(k) c.r[k] = a.r[k] << n;
  return c;
}

SP_INLINE I16 shift_right(const I16& a, int n) {
  I16 c;
  SP_EACH_REGISTER(k) c.r[k] = a.r[k] >> n;
  return c;
}

SP_INLINE void store(int32_t* p, const I16& a) {
  SP_EACH_REGISTER(k) std::memcpy(p + k * kRegisterLanes, &a.r[k], kRegisterBytes);
}

SP_INLINE F16 to_float(const I16& a) {
  F16 c;
  SP_EACH_REGISTER(k) c.r[k] = __builtin_convertvector(a.r[k], FloatRegister);
  return c;
}

// Toward zero.
SP_INLINE I16 to_int(const F16& a) {
  I16 c;
  SP_EACH_REGISTER(k) c.r[k] = __builtin_convertvector(a.r[k], IntRegister);
  return c;
}

}  // namespace splatpilot::SIMD_LEVEL
