// Rays through a grid of signed distances, and its trilinear interpolant.
#pragma once

#include "core/gather.hpp"
#include "fields/trilinear.hpp"
#include "raster/depth_image.hpp"

namespace splatpilot::SIMD_LEVEL {

constexpr int kMostSteps = 256;
constexpr float kTolerance = 0.01f;  // [-] of a voxel
// Voxels beyond the grid in which surfaces are still met: those that are its bounds, as floors are.
constexpr float kBeyond = 0.5f;

static float interpolate(const GridWorld& grid, const float* p, float* gradient) {
  size_t cell = 0;
  float f[3];
  for (int k = 0; k < 3; ++k) {
    const float last = static_cast<float>(grid.shape[k] - 1);
    const float at = clamp((p[k] - grid.first_center[k]) / grid.voxel_size, 0.0f, last);
    const int32_t below = static_cast<int32_t>(at), most = grid.shape[k] - 2;
    const int32_t i = below < most ? below : most;
    cell = cell * static_cast<size_t>(grid.shape[k]) + static_cast<size_t>(i);
    f[k] = at - static_cast<float>(i);
  }
  const size_t stride_y = static_cast<size_t>(grid.shape[2]);
  const size_t stride_x = static_cast<size_t>(grid.shape[1]) * stride_y;
  const float value = trilinear(grid.values + cell, stride_x, stride_y, f, gradient);
  for (int k = 0; k < 3; ++k) gradient[k] /= grid.voxel_size;
  return value;
}

// The interpolant at points given in voxels from the first center, extrapolated beyond the
// outermost.
SP_INLINE F16 interpolate(const GridWorld& grid, const F16* at) {
  I16 cell = to_int(F16(0.0f));
  F16 f[3];
  for (int k = 0; k < 3; ++k) {
    const F16 last = F16(static_cast<float>(grid.shape[k] - 2));
    const I16 i = to_int(clamp(at[k], F16(0.0f), last));
    cell = multiply(cell, grid.shape[k]) + i;
    f[k] = at[k] - to_float(i);
  }
  const int32_t stride_y = grid.shape[2], stride_x = grid.shape[1] * stride_y;
  const auto along_z = [&](int32_t offset) {
    const F16 low = gather(grid.values + offset, cell);
    return low + f[2] * (gather(grid.values + offset + 1, cell) - low);
  };
  const auto along_yz = [&](int32_t offset) {
    const F16 low = along_z(offset);
    return low + f[1] * (along_z(offset + stride_y) - low);
  };
  const F16 low = along_yz(0);
  return low + f[0] * (along_yz(stride_x) - low);
}

// Along a ray, from depth t, nothing is nearer than what the distance allows: sphere tracing, with
// the half width of the pixel taken off the distance.
static void cast_grid(const GridWorld& grid, const PixelRays& rays, const CameraPose& pose,
                      float* scratch, float* depth) {
  float ahead[3];
  const Image image = begin_image(rays, pose, scratch, ahead);
  const float* directions[3] = {image.x, image.y, image.z};
  const F16 per_voxel = F16(1.0f / grid.voxel_size), zero = F16(0.0f);
  for (size_t i = 0; i < image.size; i += kLanes) {
    F16 origin[3], slope[3], enter = zero, leave = F16(kInfinity);
    for (int k = 0; k < 3; ++k) {
      origin[k] = F16((pose.p[k] - grid.first_center[k]) / grid.voxel_size);
      slope[k] = load(directions[k] + i) * per_voxel;
      const float half = 0.5f * static_cast<float>(grid.shape[k]);
      const F16 per_slope = F16(1.0f) / (slope[k] + F16(kParallel));
      const F16 middle = (origin[k] + F16(0.5f - half)) * per_slope;
      const F16 width = F16(half + kBeyond) * max(per_slope, -per_slope);
      leave = min(width - middle, leave);
      enter = max(-(width + middle), enter);
    }
    const F16 speed = sqrt(load(image.square + i));
    const F16 widening = F16(rays.half_pixel) / speed;
    const F16 approach = F16(1.0f) / (speed + widening);
    F16 t = enter;
    Mask16 under_way = t < leave;
    for (int step = 0; step < kMostSteps && any(under_way); ++step) {
      const F16 at[3] = {origin[0] + t * slope[0], origin[1] + t * slope[1],
                         origin[2] + t * slope[2]};
      const F16 room = interpolate(grid, at) - t * widening;
      t += zero_unless(under_way, max(room, zero) * approach);
      under_way = under_way & (room > F16(kTolerance * grid.voxel_size)) & (t < leave);
    }
    store(image.depth + i, select(t < leave, t + t * widening, F16(kInfinity)));
  }
  write_image(image, rays, depth);
}

}  // namespace splatpilot::SIMD_LEVEL
