#include "core/dispatch.hpp"

#include <stdexcept>

#if defined(__x86_64__)
#include <cpuid.h>
#endif

namespace splatpilot {
#if defined(__x86_64__)
namespace v2 {
extern const Kernels kKernels;
}
namespace v3 {
extern const Kernels kKernels;
}
namespace v4 {
extern const Kernels kKernels;
}
#else
namespace generic {
extern const Kernels kKernels;
}
#endif

namespace {

#if defined(__x86_64__)
// Of leaves 1 and 0x80000001, in ECX: LZCNT, MOVBE, F16C, which not every compiler's
// __builtin_cpu_supports knows by name.
bool has_v3_extras() {
  unsigned a, b, c, d;
  const bool basic = __get_cpuid(1, &a, &b, &c, &d) && (c & bit_MOVBE) && (c & bit_F16C);
  return basic && __get_cpuid(0x80000001, &a, &b, &c, &d) && (c & (1u << 5));
}
#endif

// A level needs every extension that its -march lets the compiler use.
std::vector<const Kernels*> usable_kernels() {
  std::vector<const Kernels*> usable;
#if defined(__x86_64__)
  __builtin_cpu_init();
  const bool v2 = __builtin_cpu_supports("sse4.2") && __builtin_cpu_supports("popcnt");
  const bool v3 = v2 && has_v3_extras() && __builtin_cpu_supports("avx2") &&
                  __builtin_cpu_supports("fma") && __builtin_cpu_supports("bmi") &&
                  __builtin_cpu_supports("bmi2");
  const bool v4 = v3 && __builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512bw") &&
                  __builtin_cpu_supports("avx512cd") && __builtin_cpu_supports("avx512dq") &&
                  __builtin_cpu_supports("avx512vl");
  if (v4) usable.push_back(&v4::kKernels);
  if (v3) usable.push_back(&v3::kKernels);
  if (v2) usable.push_back(&v2::kKernels);
#else
  usable.push_back(&generic::kKernels);
#endif
  return usable;
}

}  // namespace

std::vector<std::string> simd_levels() {
  std::vector<std::string> names;
  for (const Kernels* k : usable_kernels()) names.emplace_back(k->name);
  return names;
}

const Kernels& kernels(const std::string& level) {
  const std::vector<const Kernels*> usable = usable_kernels();
  if (usable.empty()) throw std::invalid_argument("splatpilot needs a CPU with SSE 4.2");
  if (level.empty()) return *usable.front();
  std::string names;
  for (const Kernels* k : usable) {
    if (level == k->name) return *k;
    names += names.empty() ? k->name : std::string(", ") + k->name;
  }
  throw std::invalid_argument("SIMD level '" + level + "' is not available here; choose one of " +
                              names + " (SPLATPILOT_SIMD or the argument simd)");
}

}  // namespace splatpilot
