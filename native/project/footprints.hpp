// Splats and their planes in the coordinates of a tile, and what light they let through at 16
// points.
#pragma once

#include "core/mathematics.hpp"
#include "core/types.hpp"

namespace splatpilot::SIMD_LEVEL {

// A splat in the tile's own coordinates: u = ux x + uy y + u0, v = vy y + v0.
struct StagedSplat {
  float ux, uy, u0, vy, v0, log2_opacity;
  float red, green, blue, depth;
};

// A DepthPlane in the tile's own coordinates.
struct StagedPlane {
  float ux, uy, u0, vy, v0;
  float w_x, w_y, w, mean_w;
};

SP_INLINE StagedSplat in_tile(const Splat& s, float left, float top) {
  const float x = s.mean_x - left, y = s.mean_y - top;
  return {s.ux,       s.uy,        -(s.ux * x + s.uy * y),
          s.vy,       -(s.vy * y), s.log2_opacity,
          s.color[0], s.color[1],  s.color[2],
          s.depth};
}

SP_INLINE StagedPlane in_tile(const DepthPlane& p, const Splat& s, float left, float top) {
  const float x = s.mean_x - left, y = s.mean_y - top;
  return {p.ux,  p.uy,  -(p.ux * x + p.uy * y),        p.vy, -(p.vy * y),
          p.w_x, p.w_y, p.w - (p.w_x * x + p.w_y * y), p.w};
}

SP_INLINE F16 alpha_at(const StagedSplat& splat, const F16& x, const F16& y) {
  const F16 u = F16(splat.ux) * x + (F16(splat.uy) * y + F16(splat.u0));
  const F16 v = F16(splat.vy) * y + F16(splat.v0);
  const F16 exponent = (F16(splat.log2_opacity) - u * u) - v * v;
  return zero_unless(exponent >= F16(kLog2AlphaCut), min(exp2(exponent), F16(kMaxAlpha)));
}

// Lets the light through one splat without blur; returns whether any pixel has half of it left.
// Those that do take the splat's depth, in case it takes the half.
SP_INLINE bool seek_median(const StagedPlane& plane, float log2_opacity, const F16& x, const F16& y,
                           F16& transmittance, F16& median_w) {
  const F16 half = F16(0.5f);
  const F16 w = F16(plane.w_x) * x + (F16(plane.w_y) * y + F16(plane.w));
  const F16 u = F16(plane.ux) * x + (F16(plane.uy) * y + F16(plane.u0));
  const F16 v = F16(plane.vy) * y + F16(plane.v0);
  const F16 divisor = min(w, F16(plane.mean_w));
  const F16 exponent = F16(log2_opacity) - (u * u + v * v) / (divisor * divisor);
  const F16 alpha = zero_unless(exponent >= F16(kLog2AlphaCut), exp2(exponent));
  median_w = select(transmittance > half, w, median_w);
  transmittance = transmittance - transmittance * alpha;
  return any(transmittance > half);
}

}  // namespace splatpilot::SIMD_LEVEL
