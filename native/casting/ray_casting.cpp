// The casting kernels of one SIMD level; compiled once per level, as kernels.cpp is, but without
// fused products and sums: all levels give the same bits.
#include "casting/ray_casting.hpp"

#include "casting/grid_casting.hpp"
#include "casting/nearest_shapes.hpp"
#include "casting/shape_casting.hpp"

namespace splatpilot::SIMD_LEVEL {

extern const CastingKernels kCastingKernels;
const CastingKernels kCastingKernels = {casting_scratch, cast_shapes, cast_grid, nearest_shapes,
                                        interpolate};

}  // namespace splatpilot::SIMD_LEVEL
