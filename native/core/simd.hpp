// Packs of 16 floats or 32-bit integers: one AVX-512 register, two of AVX or four of SSE or NEON.
//
// Every kernel is written once in terms of these packs and compiled once per SIMD level, each time
// inside its own namespace SIMD_LEVEL. Kernel code must use nothing from the standard library
// that could be emitted out of line: the linker would be free to keep the copy with the widest
// instructions and call it on a machine without them.
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

// A function of packs, register by register.
#define SP_FUNCTION(Pack, signature, expression) \
  SP_INLINE Pack signature {                     \
    Pack c;                                      \
    SP_EACH_REGISTER(k) c.r[k] = (expression);   \
    return c;                                    \
  }

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

SP_FUNCTION(F16, operator-(const F16& a), -a.r[k])

SP_INLINE F16& operator+=(F16& a, const F16& b) { return a = a + b; }

using Register = FloatRegister;
#if defined(__AVX512F__)
#define SP_INTRINSIC(name) _mm512_##name
#elif defined(__AVX2__)
#define SP_INTRINSIC(name) _mm256_##name
#elif defined(__SSE4_1__)
#define SP_INTRINSIC(name) _mm_##name
#endif
#ifdef SP_INTRINSIC
SP_INLINE Register register_min(Register a, Register b) { return SP_INTRINSIC(min_ps)(a, b); }
SP_INLINE Register register_max(Register a, Register b) { return SP_INTRINSIC(max_ps)(a, b); }
SP_INLINE Register register_sqrt(Register a) { return SP_INTRINSIC(sqrt_ps)(a); }
#else
SP_INLINE Register register_min(Register a, Register b) { return a < b ? a : b; }
SP_INLINE Register register_max(Register a, Register b) { return a > b ? a : b; }
SP_INLINE Register register_sqrt(Register a) {
  for (int i = 0; i < kRegisterLanes; ++i) a[i] = __builtin_sqrtf(a[i]);
  return a;
}
#endif

// Of an unordered pair both return the second operand, as the x86 instructions do.
SP_FUNCTION(F16, min(const F16& a, const F16& b), register_min(a.r[k], b.r[k]))
SP_FUNCTION(F16, max(const F16& a, const F16& b), register_max(a.r[k], b.r[k]))

SP_INLINE F16 clamp(const F16& a, const F16& low, const F16& high) {
  return min(max(a, low), high);
}

SP_FUNCTION(F16, sqrt(const F16& a), register_sqrt(a.r[k]))
SP_FUNCTION(I16, bits_of(const F16& a), reinterpret_cast<IntRegister>(a.r[k]))
SP_FUNCTION(F16, float_from_bits(const I16& a), reinterpret_cast<FloatRegister>(a.r[k]))

// Wraps around.
SP_FUNCTION(I16, operator+(const I16& a, const I16& b),
            reinterpret_cast<IntRegister>(reinterpret_cast<UnsignedRegister>(a.r[k]) +
                                          reinterpret_cast<UnsignedRegister>(b.r[k])))
SP_FUNCTION(I16, operator-(const I16& a, int32_t b),
            reinterpret_cast<IntRegister>(reinterpret_cast<UnsignedRegister>(a.r[k]) -
                                          static_cast<uint32_t>(b)))
SP_FUNCTION(I16, operator&(const I16& a, int32_t b), a.r[k] & b)
SP_FUNCTION(I16, shift_left(const I16& a, int n), a.r[k] << n)
SP_FUNCTION(I16, shift_right(const I16& a, int n), a.r[k] >> n)

SP_INLINE void store(int32_t* p, const I16& a) {
  SP_EACH_REGISTER(k) std::memcpy(p + k * kRegisterLanes, &a.r[k], kRegisterBytes);
}

SP_FUNCTION(F16, to_float(const I16& a), __builtin_convertvector(a.r[k], FloatRegister))

// Toward zero.
SP_FUNCTION(I16, to_int(const F16& a), __builtin_convertvector(a.r[k], IntRegister))

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

SP_FUNCTION(I16, multiply(const I16& a, int32_t b), a.r[k] * b)

// p[index]
SP_INLINE F16 load_at(const float* p, const I16& index) {
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

// Packs of 16 doubles.
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

// One register of doubles; of an unordered pair `min` and `max` return the second operand.
constexpr int kDoubleLanes = kRegisterBytes / 8;

SP_INLINE DoubleRegister broadcast(double s) { return s - DoubleRegister{}; }
SP_INLINE DoubleRegister load(const double* p) {
  DoubleRegister a;
  std::memcpy(&a, p, kRegisterBytes);
  return a;
}
SP_INLINE void store(double* p, DoubleRegister a) { std::memcpy(p, &a, kRegisterBytes); }
#ifdef SP_INTRINSIC
SP_INLINE DoubleRegister min(DoubleRegister a, DoubleRegister b) {
  return SP_INTRINSIC(min_pd)(a, b);
}
SP_INLINE DoubleRegister max(DoubleRegister a, DoubleRegister b) {
  return SP_INTRINSIC(max_pd)(a, b);
}
SP_INLINE DoubleRegister sqrt(DoubleRegister a) { return SP_INTRINSIC(sqrt_pd)(a); }
#undef SP_INTRINSIC
#else
SP_INLINE DoubleRegister min(DoubleRegister a, DoubleRegister b) { return a < b ? a : b; }
SP_INLINE DoubleRegister max(DoubleRegister a, DoubleRegister b) { return a > b ? a : b; }
SP_INLINE DoubleRegister sqrt(DoubleRegister a) {
  for (int i = 0; i < kDoubleLanes; ++i) a[i] = __builtin_sqrt(a[i]);
  return a;
}
#endif

#undef SP_FUNCTION

}  // namespace splatpilot::SIMD_LEVEL
