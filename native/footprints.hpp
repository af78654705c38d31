// Splats and their planes in the coordinates of a tile, and what light they let through at 16
// points.
#pragma once

#include "mathematics.hpp"
#include "types.hpp"

namespace splatpilot::SIMD_LEVEL {

// A splat in the tile's own coordinates: u = ux x + uy y + u0, v = vy y + v0.
struct StagedSplat {
  float ux, uy, u0, vy, v0, log2_opacity;
  float red, green, blue, depth;
};

// A DepthPlane in the tile's own coordinates.
struct StagedPlane {
  float mean_x, mean_y;
  DepthPlane of;
};

SP_INLINE StagedSplat in_tile(const Splat& s, float left, float top) {
  const float x = s.mean_x - left, y = s.mean_y - top;
  return {s.ux,       s.uy,        -(s.ux * x + s.uy * y),
          s.vy,       -(s.vy * y), s.log2_opacity,
          s.color[0], s.color[1],  s.color[2],
          s.depth};
}

SP_INLINE StagedPlane in_tile(const DepthPlane& p, const Splat& s, float left, float top) {
  return {s.mean_x - left, s.mean_y - top, p};
}

SP_INLINE F16 alpha_at(const StagedSplat& splat, const F16& x, const F16& y) {
  const F16 u = F16(splat.ux) * x + (F16(splat.uy) * y + F16(splat.u0));
  const F16 v = F16(splat.vy) * y + F16(splat.v0);
  const F16 exponent = (F16(splat.log2_opacity) - u * u) - v * v;
  return zero_unless(exponent >= F16(kLog2AlphaCut), min(exp2(exponent), F16(kMaxAlpha)));
}

// Lets the light through one splat without blur; returns whether any pixel has half of it left.
// Those that do take the splat's depth, in case it takes the half: as l and as q / z.
SP_INLINE bool seek_median(const StagedPlane& plane, float log2_opacity, const F16& x, const F16& y,
                           F16& transmittance, F16& median_l, F16& median_q) {
  const DepthPlane& p = plane.of;
  const F16 half = F16(0.5f), one = F16(1.0f);
  const F16 dx = x - F16(plane.mean_x), dy = y - F16(plane.mean_y);
  const F16 u = F16(p.ux) * dx + F16(p.uy) * dy;
  const F16 v = F16(p.vy) * dy;
  const F16 l = one + (F16(p.l_x) * dx + F16(p.l_y) * dy);
  const F16 b = dx * (F16(p.b_xx) * dx + F16(p.b_xy) * dy) + F16(p.b_yy) * (dy * dy);
  const F16 q = max((l + l - one) + b, l * l);  // but for rounding it is never less
  const F16 exponent = F16(log2_opacity) - (u * u + v * v) / q;
  const Mask16 hit = (l > F16(0.0f)) & (exponent >= F16(kLog2AlphaCut));
  const F16 alpha = zero_unless(hit, exp2(exponent));
  const Mask16 open = transmittance > half;
  median_l = select(open, l, median_l);
  median_q = select(open, F16(p.inverse_z) * q, median_q);
  transmittance = transmittance - transmittance * alpha;
  return any(transmittance > half);
}

}  // namespace splatpilot::SIMD_LEVEL
