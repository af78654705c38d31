// Planes of the median depth, and which of them may be shown, 16 at a time.
#pragma once

#include "project/projection.hpp"

namespace splatpilot::SIMD_LEVEL {

// One pack per field of DepthPlane.
struct PlanePack {
  F16 ux, uy, vy, w_x, w_y, w;
};

// From P of `finish_projection` and n_C, the inverse covariance times p_C up to scale.
template <bool kDistorted = false>
SP_INLINE PlanePack depth_plane(const Camera& camera, const Vector16& p_C, const F16& inverse_z,
                                const Vector16& p0, const Vector16& p1, const Vector16& n_C) {
  // What keeps a Gaussian seen edge-on invertible [px^2].
  const F16 least = F16(1e-8f), one = F16(1.0f);
  PlanePack out;
  const F16 s00 = p0.x * p0.x + p0.y * p0.y + p0.z * p0.z;
  const F16 s11 = p1.x * p1.x + p1.y * p1.y + p1.z * p1.z + least;
  const F16 s01 = p0.x * p1.x + p0.y * p1.y + p0.z * p1.z;
  const Vector16 c = cross(p0, p1);
  const F16 det = (c.x * c.x + c.y * c.y + c.z * c.z) + least * (s00 + s11);
  const F16 inverse = one / (s11 * det);
  const F16 root = F16(kExponentScale) * sqrt(inverse);
  out.ux = min(root * s11, F16(1e6f)) * inverse_z;
  out.uy = -(out.ux * s01 * (inverse * det));
  out.vy = root * sqrt(det) * inverse_z;

  const F16 facing = n_C.x * p_C.x + (n_C.y * p_C.y + n_C.z * p_C.z);
  const Mask16 known = (facing > F16(1e-30f)) & (facing < F16(1e30f));
  const F16 inverse_facing = zero_unless(known, one / facing);
  out.w_x = n_C.x * inverse_facing * F16(1.0f / camera.fx);
  out.w_y = n_C.y * inverse_facing * F16(1.0f / camera.fy);
  if constexpr (kDistorted) {
    // By the pixel instead of the slope: the inverse of the lens's Jacobian.
    const DistortedPoint p = distort(camera.distortion, p_C.x * inverse_z, p_C.y * inverse_z);
    const F16 share = inverse_facing / (p.xx * p.yy - p.xy * p.xy);
    out.w_x = (n_C.x * p.yy - n_C.y * p.xy) * share * F16(1.0f / camera.fx);
    out.w_y = (n_C.y * p.xx - n_C.x * p.xy) * share * F16(1.0f / camera.fy);
  }
  out.w = inverse_z;
  // A Gaussian that reaches to the camera's plane is turned, so that it has depth everywhere.
  const F16 fall =
      F16(kMaxExtent * kMaxExtent) *
      (out.w_x * out.w_x * s00 + (out.w_y * out.w_y * s11 + F16(2.0f) * out.w_x * out.w_y * s01));
  const F16 most = F16(kMostFall) * inverse_z;
  if (any(fall > most * most)) {
    const F16 turn = min(most / sqrt(max(fall, F16(1e-30f))), one);
    out.w_x = turn * out.w_x;
    out.w_y = turn * out.w_y;
  }
  return out;
}

// Lanes that may show a surface within the camera's max_depth. Of a Gaussian whose center is at
// depth z, and whose deviation along the optical axis is sigma, the plane of the median depth comes
// no nearer than z^2 / (z + kMaxExtent sigma) where alpha is above the cut: toward its rim the
// inverse depth rises by kMaxExtent sqrt(w^T S w), w being the plane's (w_x, w_y) and S the
// covariance on the image, which is at most kMaxExtent sigma / z^2. Boxes of Gaussians are judged
// with `slack`.
SP_INLINE Mask16 within_max_depth(const Camera& camera, const F16& z, const F16& sigma,
                                  float slack = 1.0f) {
  return z * z <= F16(slack * camera.max_depth) * (z + F16(kMaxExtent) * sigma);
}

SP_INLINE F16 norm(const Vector16& a) { return sqrt(a.x * a.x + (a.y * a.y + a.z * a.z)); }

// Makes the planes of lanes outside the mask let all light through: NaN is above no cut.
SP_INLINE void hide_unless(const Mask16& shown, PlanePack& plane) {
  plane.ux = select(shown, plane.ux, F16(__builtin_nanf("")));
}

// Appends the lanes in `bits`, in lane order.
SP_INLINE void append_planes(const PlanePack& p, uint32_t bits, DepthPlane* planes) {
  alignas(64) float fields[6][kLanes];
  const F16* packs[6] = {&p.ux, &p.uy, &p.vy, &p.w_x, &p.w_y, &p.w};
  for (int f = 0; f < 6; ++f) store(fields[f], *packs[f]);
  for (; bits; bits &= bits - 1, ++planes) {
    const int lane = __builtin_ctz(bits);
    *planes = {fields[0][lane], fields[1][lane], fields[2][lane],
               fields[3][lane], fields[4][lane], fields[5][lane]};
  }
}

}  // namespace splatpilot::SIMD_LEVEL
