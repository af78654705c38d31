#include "core/dispatch.hpp"

#include <stdexcept>

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

std::vector<const Kernels*> usable_kernels() {
  std::vector<const Kernels*> usable;
#if defined(__x86_64__)
  __builtin_cpu_init();
  if (__builtin_cpu_supports("x86-64-v4")) usable.push_back(&v4::kKernels);
  if (__builtin_cpu_supports("x86-64-v3")) usable.push_back(&v3::kKernels);
  if (__builtin_cpu_supports("x86-64-v2")) usable.push_back(&v2::kKernels);
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
