// Projection of Gaussians to splats on the image plane (EWA; Zwicker et al. 2001, Kerbl et al.
// 2023) and to planes of the median depth, 16 at a time, through a pinhole or OpenCV's rational and
// fisheye lenses.
#pragma once

#include "core/mathematics.hpp"
#include "core/types.hpp"
#include "core/vectors.hpp"

namespace splatpilot::SIMD_LEVEL {

// The image point of a ray at focal length 1, and the Jacobian by the slopes (x/z, y/z), which is
// symmetric in both models.
struct DistortedPoint {
  F16 x, y, xx, xy, yy;
};

SP_INLINE F16 polynomial3(const float k[3], const F16& s) {
  return F16(1.0f) + s * (F16(k[0]) + s * (F16(k[1]) + s * F16(k[2])));
}

// The derivative of polynomial3.
SP_INLINE F16 slope3(const float k[3], const F16& s) {
  return F16(k[0]) + s * (F16(2.0f * k[1]) + s * F16(3.0f * k[2]));
}

SP_INLINE DistortedPoint distort(const Distortion& lens, const F16& x, const F16& y) {
  const F16 s = x * x + y * y;
  F16 g, slope;  // (x', y') = g(s) (x, y) + tangential part; dg/ds
  if (lens.model == DistortionModel::kFisheye) {
    // Avoids 0 / 0 on the axis; the quotients are exact enough so near it.
    const F16 safe = max(s, F16(1e-12f));
    const F16 r = sqrt(safe);
    const F16 angle = arctangent(r);
    const F16 a = angle * angle;
    const float* k = lens.radial;
    const F16 inverse_r = F16(1.0f) / r;
    g = angle * inverse_r *
        (F16(1.0f) + a * (F16(k[0]) + a * (F16(k[1]) + a * (F16(k[2]) + a * F16(k[3])))));
    const F16 growth =
        F16(1.0f) + a * (F16(3.0f * k[0]) +
                         a * (F16(5.0f * k[1]) + a * (F16(7.0f * k[2]) + a * F16(9.0f * k[3]))));
    slope = F16(0.5f) * inverse_r * inverse_r * (growth / (F16(1.0f) + safe) - g);
  } else {
    const F16 inverse = F16(1.0f) / polynomial3(lens.radial + 3, s);
    g = polynomial3(lens.radial, s) * inverse;
    slope = (slope3(lens.radial, s) - g * slope3(lens.radial + 3, s)) * inverse;
  }
  const F16 p1 = F16(lens.tangential[0]), p2 = F16(lens.tangential[1]);
  const F16 two = F16(2.0f), six = F16(6.0f);
  DistortedPoint out;
  out.x = g * x + (two * p1 * x * y + p2 * (s + two * x * x));
  out.y = g * y + (p1 * (s + two * y * y) + two * p2 * x * y);
  out.xx = g + two * x * x * slope + (two * p1 * y + six * p2 * x);
  out.xy = two * x * y * slope + (two * p1 * x + two * p2 * y);
  out.yy = g + two * y * y * slope + (six * p1 * y + two * p2 * x);
  return out;
}

// Rays that meet the image where the lens does not fold it back.
SP_INLINE Mask16 is_on_image(const Distortion& lens, const F16& x, const F16& y,
                             const DistortedPoint& p) {
  return (F16(lens.max_squared_slope) > x * x + y * y) & (p.xx + p.yy > F16(0.0f)) &
         (p.xx * p.yy - p.xy * p.xy > F16(0.0f));
}

// p_W relative to the camera center, still in world axes.
SP_INLINE Vector16 from_center(const Camera& camera, const F16& x, const F16& y, const F16& z) {
  return {(x - F16(camera.center_high[0])) - F16(camera.center_low[0]),
          (y - F16(camera.center_high[1])) - F16(camera.center_low[1]),
          (z - F16(camera.center_high[2])) - F16(camera.center_low[2])};
}

template <typename T>
SP_INLINE Vector3<T> to_camera(const Camera& camera, const Vector3<T>& d_W) {
  return {dot(camera.R_CW, d_W), dot(camera.R_CW + 3, d_W), dot(camera.R_CW + 6, d_W)};
}

SP_INLINE Vector16 broadcast(const float v[3]) { return {F16(v[0]), F16(v[1]), F16(v[2])}; }

SP_INLINE Mask16 in_depth_range(const Camera& camera, const F16& z) {
  return (z >= F16(camera.near_plane)) & (z <= F16(camera.far_plane));
}

// The projection's Jacobian at p_C by world axes, m[i] = J_i R_CW, with the slopes x/z and y/z
// clamped to 1.3 times the field of view as in the original method.
template <bool kDistorted = false>
SP_INLINE void projection_rows(const Camera& camera, const Vector16& p_C, const F16& inverse_z,
                               Vector16 m[2]) {
  const F16 slope_x = clamp(p_C.x * inverse_z, F16(camera.min_slope_x), F16(camera.max_slope_x));
  const F16 slope_y = clamp(p_C.y * inverse_z, F16(camera.min_slope_y), F16(camera.max_slope_y));
  const F16 scale_x = F16(camera.fx) * inverse_z;
  const F16 scale_y = F16(camera.fy) * inverse_z;
  const Vector16 forward = broadcast(camera.R_CW + 6);
  const Vector16 by_x = broadcast(camera.R_CW) - slope_x * forward;
  const Vector16 by_y = broadcast(camera.R_CW + 3) - slope_y * forward;
  if constexpr (kDistorted) {
    const DistortedPoint p = distort(camera.distortion, slope_x, slope_y);
    m[0] = scale_x * (p.xx * by_x + p.xy * by_y);
    m[1] = scale_y * (p.xy * by_x + p.yy * by_y);
    return;
  }
  m[0] = scale_x * by_x;
  m[1] = scale_y * by_y;
}

// Sixteen projected Gaussians, one pack per field of Splat.
struct SplatPack {
  F16 mean_x, mean_y, extent_x, extent_y, ux, uy, vy, log2_opacity, depth, slope_x, slope_y;
};

SP_INLINE F16 largest_component(const Vector16& a) {
  return max(max(max(a.x, -a.x), max(a.y, -a.y)), max(a.z, -a.z));
}

// Lanes whose interval mean -+ extent holds the center of a pixel.
SP_INLINE Mask16 hold_center(const F16& mean, const F16& extent) {
  // The nearest integer: adding 1.5 * 2^23 rounds. Means beyond have no fraction to lose.
  const F16 corner = mean - F16(0.5f);
  const F16 away = corner - ((corner + F16(12582912.0f)) - F16(12582912.0f));
  return (away <= extent) & (-away <= extent);
}

// Projects from P (2x3), where P P^T is the 2D covariance before blurring; returns the visible
// lanes. The factor keeps needles accurate: det(P P^T) = |p0 x p1|^2 subtracts no large products.
template <bool kDistorted = false>
SP_INLINE Mask16 finish_projection(const Camera& camera, const Vector16& p_C, const F16& inverse_z,
                                   Vector16 p0, Vector16 p1, F16 log2_opacity, SplatPack& out) {
  // Scaling by g keeps the squares of huge Gaussians within range; it is exactly 1 for all others.
  const F16 largest = max(max(largest_component(p0), largest_component(p1)), F16(1e8f));
  const F16 g = F16(1e8f) / largest;
  p0 = g * p0;
  p1 = g * p1;
  const F16 blur = F16(camera.eps2d) * g * g;
  const F16 raw00 = dot(p0, p0), raw11 = dot(p1, p1);
  const F16 s00 = raw00 + blur;
  const F16 s11 = raw11 + blur;
  const F16 s01 = dot(p0, p1);
  const Vector16 c = cross(p0, p1);
  const F16 raw_det = dot(c, c);
  const F16 det = raw_det + blur * (raw00 + raw11 + blur);
  if (camera.antialiased) {
    // The opacity falls by as much as the blur adds to the area (Yu et al. 2024).
    log2_opacity += F16(0.5f) * log2(max(raw_det / det, F16(1e-30f)));
  }

  const F16 inverse_sigma_y = F16(1.0f) / sqrt(s11);
  out.vy = F16(kExponentScale) * inverse_sigma_y * g;
  out.ux = F16(kExponentScale) * sqrt(s11 / det) * g;
  out.slope_x = s01 * inverse_sigma_y * inverse_sigma_y;
  out.slope_y = s01 / s00;
  out.uy = -(out.ux * out.slope_x);
  out.mean_x = F16(camera.fx) * p_C.x * inverse_z + F16(camera.cx);
  out.mean_y = F16(camera.fy) * p_C.y * inverse_z + F16(camera.cy);
  Mask16 visible = in_depth_range(camera, p_C.z);
  if constexpr (kDistorted) {
    const F16 slope_x = p_C.x * inverse_z, slope_y = p_C.y * inverse_z;
    const DistortedPoint p = distort(camera.distortion, slope_x, slope_y);
    out.mean_x = F16(camera.fx) * p.x + F16(camera.cx);
    out.mean_y = F16(camera.fy) * p.y + F16(camera.cy);
    visible = visible & is_on_image(camera.distortion, slope_x, slope_y, p);
  }
  out.log2_opacity = log2_opacity;
  out.depth = p_C.z;

  // alpha >= 1/255 where u^2 + v^2 <= log2(255 o).
  const F16 budget = log2_opacity - F16(kLog2AlphaCut);
  const F16 extent = sqrt(max(budget, F16(0.0f))) * F16(1.0f / kExponentScale);
  out.extent_x = extent * sqrt(s00) / g;
  out.extent_y = extent * sqrt(s11) / g;
  const F16 clip = F16(camera.radius_clip);
  const F16 width = F16(static_cast<float>(camera.width));
  const F16 height = F16(static_cast<float>(camera.height));
  visible = visible & (budget >= F16(0.0f));
  visible = visible & (max(out.extent_x, out.extent_y) > clip);
  visible = visible & (out.mean_x + out.extent_x > F16(0.0f)) &
            (out.mean_x - out.extent_x < width) & (out.mean_y + out.extent_y > F16(0.0f)) &
            (out.mean_y - out.extent_y < height);
  if (camera.depth_alone) {
    visible =
        visible & hold_center(out.mean_x, out.extent_x) & hold_center(out.mean_y, out.extent_y);
  }
  // An overflow somewhere leaves an infinity or a NaN in one of these.
  const F16 finite = (out.ux + out.vy) * F16(0.0f) + out.uy * F16(0.0f);
  return visible & (finite >= F16(0.0f));
}

// Appends the lanes in `bits`, in lane order.
SP_INLINE size_t append_splats(const SplatPack& p, const F16 color[3], uint32_t bits,
                               const uint32_t* indices, Splat* splats, uint32_t* depth_bits) {
  alignas(64) float fields[14][kLanes];
  const F16* packs[14] = {&p.mean_x, &p.mean_y, &p.extent_x,     &p.extent_y, &p.ux,
                          &p.uy,     &p.vy,     &p.log2_opacity, color,       color + 1,
                          color + 2, &p.depth,  &p.slope_x,      &p.slope_y};
  for (int f = 0; f < 14; ++f) store(fields[f], *packs[f]);
  size_t count = 0;
  for (; bits; bits &= bits - 1) {
    const int lane = __builtin_ctz(bits);
    // Field by field: storing a whole row would wait for its parts.
    float* row = reinterpret_cast<float*>(splats + count);
    for (int f = 0; f < 14; ++f) row[f] = fields[f][lane];
    splats[count].index = indices[lane];
    std::memcpy(depth_bits + count, fields[11] + lane, sizeof(uint32_t));
    ++count;
  }
  return count;
}

// One pack per field of DepthPlane.
struct PlanePack {
  F16 ux, uy, vy, w_x, w_y, w;
};

// From P of `finish_projection` and n_C, the inverse covariance times p_C up to scale.
template <bool kDistorted>
SP_INLINE PlanePack depth_plane(const Camera& camera, const Vector16& p_C, const F16& inverse_z,
                                const Vector16& p0, const Vector16& p1, const Vector16& n_C) {
  // Keeps a Gaussian seen edge-on invertible [px^2].
  const F16 margin = F16(1e-8f), one = F16(1.0f);
  PlanePack out;
  const F16 s00 = dot(p0, p0), s11 = dot(p1, p1) + margin, s01 = dot(p0, p1);
  const Vector16 c = cross(p0, p1);
  const F16 det = dot(c, c) + margin * (s00 + s11);
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
  // Rotates a Gaussian that reaches the camera's plane, so that it has depth everywhere.
  const F16 fall =
      F16(kMaxExtent * kMaxExtent) *
      (out.w_x * out.w_x * s00 + (out.w_y * out.w_y * s11 + F16(2.0f) * out.w_x * out.w_y * s01));
  const F16 max_fall = F16(kMaxFall) * inverse_z;
  if (any(fall > max_fall * max_fall)) {
    const F16 turn = min(max_fall / sqrt(max(fall, F16(1e-30f))), one);
    out.w_x = turn * out.w_x;
    out.w_y = turn * out.w_y;
  }
  return out;
}

// Lanes that may show a surface within the camera's max_depth. For a center at depth z and a
// standard deviation sigma along the optical axis, the plane is at least z^2 / (z + kMaxExtent
// sigma) deep where alpha is above the cut: toward the rim the inverse depth rises by at most
// kMaxExtent sigma / z^2. `slack` allows for rounding of boxes of Gaussians.
SP_INLINE Mask16 within_max_depth(const Camera& camera, const F16& z, const F16& sigma,
                                  float slack = 1.0f) {
  return z * z <= F16(slack * camera.max_depth) * (z + F16(kMaxExtent) * sigma);
}

SP_INLINE F16 norm(const Vector16& a) { return sqrt(a.x * a.x + (a.y * a.y + a.z * a.z)); }

// Makes planes outside the mask transparent: NaN is above no cut.
SP_INLINE void hide_unless(const Mask16& shown, PlanePack& plane) {
  plane.ux = select(shown, plane.ux, F16(__builtin_nanf("")));
}

SP_INLINE void append_planes(const PlanePack& p, uint32_t bits, DepthPlane* planes) {
  alignas(64) float fields[6][kLanes];
  const F16* packs[6] = {&p.ux, &p.uy, &p.vy, &p.w_x, &p.w_y, &p.w};
  for (int f = 0; f < 6; ++f) store(fields[f], *packs[f]);
  for (; bits; bits &= bits - 1, ++planes) {
    const int lane = __builtin_ctz(bits);
    *planes = {fields[0][lane],
               fields[1][lane],
               fields[2][lane],
               fields[3][lane],
               fields[4][lane],
               fields[5][lane],
               {}};
  }
}

}  // namespace splatpilot::SIMD_LEVEL
