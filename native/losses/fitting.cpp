// The fitting kernels of one SIMD level; compiled once per level with SIMD_LEVEL set to its name.
#include "losses/fitting.hpp"

#include "core/mathematics.hpp"

namespace splatpilot::SIMD_LEVEL {

// Calls f(start, count) for packs of `count` <= kLanes numbers.
template <typename Function>
SP_INLINE void each_pack(size_t total, const Function& f) {
  size_t i = 0;
  for (; i + kLanes <= total; i += kLanes) f(i, size_t{kLanes});
  if (i < total) f(i, total - i);
}

// e^x, of x as far as floats go.
SP_INLINE F16 exponential(const F16& x) {
  return exp2(clamp(x * F16(1.44269504089f), F16(-126.0f), F16(127.0f)));
}

static void shapes(const ShapeInput& in) {
  each_pack(3 * in.n, [&](size_t i, size_t count) {
    float smallest[kLanes] = {};
    for (size_t k = 0; k < count; ++k) smallest[k] = in.smallest[(i + k) / 3];
    const F16 least = load(smallest);
    const F16 twice = F16(2.0f) * load_first(in.log_scales + i, count);
    store_first(in.scales + i, sqrt(exponential(twice) + least * least), count);
  });
  each_pack(in.n, [&](size_t i, size_t count) {
    const F16 e = exponential(-load_first(in.logit_opacities + i, count));
    store_first(in.opacities + i, F16(1.0f) / (F16(1.0f) + e), count);
  });
}

static void shapes_backward(const ShapeGradientInput& in) {
  each_pack(3 * in.n, [&](size_t i, size_t count) {
    float smallest[kLanes] = {};
    for (size_t k = 0; k < count; ++k) smallest[k] = in.smallest[(i + k) / 3];
    const F16 least = load(smallest), v = load_first(in.v_scales + i, count);
    const F16 scale = max(load_first(in.scales + i, count), F16(1.2e-38f));
    store_first(in.v_log_scales + i, v * (scale - least * least / scale), count);
  });
  each_pack(in.n, [&](size_t i, size_t count) {
    const F16 o = load_first(in.opacities + i, count);
    const F16 v = load_first(in.v_opacities + i, count);
    store_first(in.v_logit_opacities + i, v * o * (F16(1.0f) - o), count);
  });
}

extern const FittingKernels kFittingKernels;
const FittingKernels kFittingKernels = {shapes, shapes_backward};

}  // namespace splatpilot::SIMD_LEVEL
