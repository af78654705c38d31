// The surfel kernels of one SIMD level; compiled once per level, as kernels.cpp is.
#include "surfels/surfel_projection_backward.hpp"
#include "surfels/surfel_raster_backward.hpp"
#include "surfels/surfel_tiles.hpp"

namespace splatpilot::SIMD_LEVEL {

extern const SurfelKernels kSurfelKernels;
const SurfelKernels kSurfelKernels = {project_surfels, bin_footprints<SurfelFootprint>,
                                      raster_surfels, raster_surfels_backward,
                                      project_surfels_backward};

}  // namespace splatpilot::SIMD_LEVEL
