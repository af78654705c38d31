// The loss kernels of one SIMD level; compiled once per level with SIMD_LEVEL set to its name.
#include "losses.hpp"

#include "log_depth.hpp"
#include "photometric.hpp"

namespace splatpilot {
namespace SIMD_LEVEL {

static const LossKernels kLossTable = {photometric_scratch, photometric, log_depth};

}  // namespace SIMD_LEVEL

#define SP_LOSS_JOIN_OF(a, b) a##b
#define SP_LOSS_JOIN(a, b) SP_LOSS_JOIN_OF(a, b)
const LossKernels& SP_LOSS_JOIN(loss_kernels_, SIMD_LEVEL)() { return SIMD_LEVEL::kLossTable; }

}  // namespace splatpilot
