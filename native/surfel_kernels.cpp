// The surfel kernels of one SIMD level; compiled once per level, as kernels.cpp is.
#include "surfel_projection_backward.hpp"
#include "surfel_raster_backward.hpp"
#include "surfel_tiles.hpp"

namespace splatpilot {
namespace SIMD_LEVEL {

#define SP_STRING_OF(name) #name
#define SP_STRING(name) SP_STRING_OF(name)
static const SurfelKernels kSurfelTable = {
    SP_STRING(SIMD_LEVEL), project_surfels,         bin_footprints<SurfelFootprint>,
    raster_surfels,        raster_surfels_backward, project_surfels_backward};

}  // namespace SIMD_LEVEL

#define SP_JOIN_OF(a, b) a##b
#define SP_JOIN(a, b) SP_JOIN_OF(a, b)
const SurfelKernels& SP_JOIN(surfel_kernels_, SIMD_LEVEL)() { return SIMD_LEVEL::kSurfelTable; }

}  // namespace splatpilot
