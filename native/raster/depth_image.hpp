// What a camera sees, in packs of rays: the beginning, the end and the nearest surface.
#pragma once

#include "casting/ray_casting.hpp"
#include "core/vectors.hpp"

namespace splatpilot::SIMD_LEVEL {

constexpr float kInfinity = __builtin_inff();
constexpr float kGraze = 1e-4f;     // [m], a shorter way through a shape is a miss
constexpr float kParallel = 1e-9f;  // keeps cosines that are divided by from 0

// What one camera sees so far.
struct Image {
  const float *x, *y, *z;  // rays in W, of depth 1
  const float* square;     // of their lengths
  float* depth;
  size_t size;  // whole packs
  float half_pixel;
  const float* p;      // the camera
  const float* ahead;  // its z axis in W
  float least;         // depth that the shape at hand can have at least
};

// Half the width of a pixel across the way `away` from the camera [m].
SP_INLINE float footprint(const Image& image, const float* away) {
  const float planar = maximum(dot(away, image.ahead), 0.0f);
  return image.half_pixel * planar * planar / maximum(length(away), 1e-3f);
}

SP_INLINE bool may_be_seen(const Image& image, size_t i) {
  return any(load(image.depth + i) > F16(image.least));
}

SP_INLINE F16 dot_rays(const Image& image, size_t i, const float* a) {
  return F16(a[0]) * load(image.x + i) + F16(a[1]) * load(image.y + i) +
         F16(a[2]) * load(image.z + i);
}

// Rays that enter a shape widened by `extra` before they leave it see it.
SP_INLINE void see(const Image& image, size_t i, const F16& enter, const F16& leave, float extra) {
  const F16 begin = max(enter, F16(0.0f));
  const F16 depth = select(leave - begin >= F16(kGraze), begin + F16(extra), F16(kInfinity));
  store(image.depth + i, min(depth, load(image.depth + i)));
}

SP_INLINE size_t whole_packs(size_t count) { return (count + kLanes - 1) / kLanes * kLanes; }

static size_t casting_scratch(size_t rays, size_t bodies) {
  return 5 * whole_packs(rays) + 2 * bodies;
}

// The image of a camera that has seen nothing yet.
SP_INLINE Image begin_image(const PixelRays& rays, const CameraPose& pose, float* scratch,
                            float* ahead) {
  const size_t size = whole_packs(rays.count);
  float* in_W[5];
  for (int k = 0; k < 5; ++k) in_W[k] = scratch + k * size;
  for (size_t i = 0; i < size; i += kLanes) {
    F16 square = F16(0.0f);
    for (int k = 0; k < 3; ++k) {
      const F16 d = F16(pose.R[3 * k]) * load(rays.x + i) +
                    F16(pose.R[3 * k + 1]) * load(rays.y + i) + F16(pose.R[3 * k + 2]);
      store(in_W[k] + i, d);
      square += d * d;
    }
    store(in_W[3] + i, square);
    store(in_W[4] + i, F16(kInfinity));
  }
  for (int k = 0; k < 3; ++k) ahead[k] = pose.R[3 * k + 2];
  return {in_W[0], in_W[1],         in_W[2], in_W[3], in_W[4],
          size,    rays.half_pixel, pose.p,  ahead,   -kInfinity};
}

SP_INLINE void write_image(const Image& image, const PixelRays& rays, float* depth) {
  for (size_t i = 0; i < rays.count; ++i) depth[rays.pixels[i]] = image.depth[i];
}

}  // namespace splatpilot::SIMD_LEVEL
