// The casting kernels of one SIMD level; compiled once per level, as kernels.cpp is, but without
// fused products and sums: all levels give the same bits.
#include "ray_casting.hpp"

#include "grid_casting.hpp"
#include "shape_casting.hpp"
#include "shape_distances.hpp"

namespace splatpilot::SIMD_LEVEL {

extern const CastingKernels kCastingKernels;
const CastingKernels kCastingKernels = {casting_scratch, cast_shapes, cast_grid, nearest_shapes,
                                        interpolate};

}  // namespace splatpilot::SIMD_LEVEL
