// The kernels of one SIMD level; compiled once per level with SIMD_LEVEL set to its name.
#include "backward/projection_backward.hpp"
#include "backward/raster_backward.hpp"
#include "project/project_gaussians.hpp"
#include "raster/tiles.hpp"

namespace splatpilot::SIMD_LEVEL {

static bool all_within(const float* values, size_t count, float low, float high) {
  uint32_t bits = 0xffff;
  size_t i = 0;
  for (; i + kLanes <= count; i += kLanes) {
    const F16 v = load(values + i);
    bits &= lane_bits((v >= F16(low)) & (v <= F16(high)));
  }
  bool within = bits == 0xffff;
  for (; i < count; ++i) within = within && values[i] >= low && values[i] <= high;
  return within;
}

static bool all_normalizable(const float* quats, size_t count) {
  bool all = true;
  for (size_t i = 0; i < count; ++i) {
    const float* q = quats + 4 * i;
    const float squared = q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3];
    all &= squared >= kMinSquaredNorm;
    all &= squared <= kMaxSquaredNorm;
  }
  return all;
}

extern const SurfelKernels kSurfelKernels;
extern const LossKernels kLossKernels;
extern const CastingKernels kCastingKernels;
extern const FlightKernels kFlightKernels;

#define SP_STRING_OF(name) #name
#define SP_STRING(name) SP_STRING_OF(name)
extern const Kernels kKernels;
const Kernels kKernels = {SP_STRING(SIMD_LEVEL),
                          &kSurfelKernels,
                          &kLossKernels,
                          &kCastingKernels,
                          &kFlightKernels,
                          project_arrays,
                          project_baked,
                          bin_footprints<SplatFootprint>,
                          raster_tile,
                          raster_tile_backward,
                          sum_pairs,
                          project_backward,
                          all_within,
                          all_normalizable};

}  // namespace splatpilot::SIMD_LEVEL
