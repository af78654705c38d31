// The loss kernels of one SIMD level; compiled once per level with FLYSPLAT_LEVEL set to its name.
#include "losses.hpp"

#include "log_depth.hpp"
#include "photometric.hpp"

namespace flysplat {
namespace FLYSPLAT_LEVEL {

static const LossKernels kLossTable = {photometric_scratch, photometric, log_depth};

}  // namespace FLYSPLAT_LEVEL

#define FS_LOSS_JOIN_OF(a, b) a##b
#define FS_LOSS_JOIN(a, b) FS_LOSS_JOIN_OF(a, b)
const LossKernels& FS_LOSS_JOIN(loss_kernels_, FLYSPLAT_LEVEL)() {
  return FLYSPLAT_LEVEL::kLossTable;
}

}  // namespace flysplat
