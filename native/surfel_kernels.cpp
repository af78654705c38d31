// The surfel kernels of one SIMD level; compiled once per level, as kernels.cpp is.
#include "surfel_projection_backward.hpp"
#include "surfel_raster_backward.hpp"
#include "surfel_tiles.hpp"

namespace flysplat {
namespace FLYSPLAT_LEVEL {

#define FS_STRING_OF(name) #name
#define FS_STRING(name) FS_STRING_OF(name)
static const SurfelKernels kSurfelTable = {
    FS_STRING(FLYSPLAT_LEVEL), project_surfels,         bin_footprints<SurfelFootprint>,
    raster_surfels,            raster_surfels_backward, project_surfels_backward};

}  // namespace FLYSPLAT_LEVEL

#define FS_JOIN_OF(a, b) a##b
#define FS_JOIN(a, b) FS_JOIN_OF(a, b)
const SurfelKernels& FS_JOIN(surfel_kernels_, FLYSPLAT_LEVEL)() {
  return FLYSPLAT_LEVEL::kSurfelTable;
}

}  // namespace flysplat
