// The loss kernels of one SIMD level; compiled once per level with SIMD_LEVEL set to its name.
#include "losses/losses.hpp"

#include "losses/log_depth.hpp"
#include "losses/photometric.hpp"

namespace splatpilot::SIMD_LEVEL {

extern const LossKernels kLossKernels;
const LossKernels kLossKernels = {photometric_scratch, photometric, log_depth};

}  // namespace splatpilot::SIMD_LEVEL
