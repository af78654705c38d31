// From Gaussians in the world to splats on the image plane (EWA projection; Zwicker et al. 2001,
// Kerbl et al. 2023), 16 at a time.
#pragma once

#include "core/mathematics.hpp"
#include "core/types.hpp"
#include "project/distortion.hpp"
#include "project/spherical_harmonics.hpp"

namespace splatpilot::SIMD_LEVEL {

struct Vector16 {
  F16 x, y, z;
};

SP_INLINE Vector16 operator*(const F16& s, const Vector16& a) {
  return {s * a.x, s * a.y, s * a.z};
}
SP_INLINE Vector16 operator+(const Vector16& a, const Vector16& b) {
  return {a.x + b.x, a.y + b.y, a.z + b.z};
}
SP_INLINE Vector16 operator-(const Vector16& a, const Vector16& b) {
  return {a.x - b.x, a.y - b.y, a.z - b.z};
}

template <typename Vector>
SP_INLINE Vector cross(const Vector& a, const Vector& b) {
  return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
}

SP_INLINE F16 dot(const float n[3], const Vector16& p) {
  return F16(n[0]) * p.x + (F16(n[1]) * p.y + F16(n[2]) * p.z);
}

// p_W relative to the camera center, still in world axes.
SP_INLINE Vector16 from_center(const Camera& camera, const F16& x, const F16& y, const F16& z) {
  return {(x - F16(camera.center_high[0])) - F16(camera.center_low[0]),
          (y - F16(camera.center_high[1])) - F16(camera.center_low[1]),
          (z - F16(camera.center_high[2])) - F16(camera.center_low[2])};
}

SP_INLINE Vector16 to_camera(const Camera& camera, const Vector16& d_W) {
  return {dot(camera.R_CW, d_W), dot(camera.R_CW + 3, d_W), dot(camera.R_CW + 6, d_W)};
}

SP_INLINE Mask16 in_depth_range(const Camera& camera, const F16& z) {
  return (z >= F16(camera.near_plane)) & (z <= F16(camera.far_plane));
}

// The image of the world axes under the projection's Jacobian at p_C: m[i] = J_i R_CW, with the
// slopes x/z and y/z held within 1.3 times the field of view as in the original method.
template <bool kDistorted = false>
SP_INLINE void projection_rows(const Camera& camera, const Vector16& p_C, const F16& inverse_z,
                               Vector16 m[2]) {
  const F16 slope_x = clamp(p_C.x * inverse_z, F16(camera.min_slope_x), F16(camera.max_slope_x));
  const F16 slope_y = clamp(p_C.y * inverse_z, F16(camera.min_slope_y), F16(camera.max_slope_y));
  const F16 scale_x = F16(camera.fx) * inverse_z;
  const F16 scale_y = F16(camera.fy) * inverse_z;
  const float* R = camera.R_CW;
  if constexpr (kDistorted) {
    const DistortedPoint p = distort(camera.distortion, slope_x, slope_y);
    const Vector16 by_x = {F16(R[0]) - slope_x * F16(R[6]), F16(R[1]) - slope_x * F16(R[7]),
                           F16(R[2]) - slope_x * F16(R[8])};
    const Vector16 by_y = {F16(R[3]) - slope_y * F16(R[6]), F16(R[4]) - slope_y * F16(R[7]),
                           F16(R[5]) - slope_y * F16(R[8])};
    m[0] = scale_x * (p.xx * by_x + p.xy * by_y);
    m[1] = scale_y * (p.xy * by_x + p.yy * by_y);
    return;
  }
  m[0] = {scale_x * (F16(R[0]) - slope_x * F16(R[6])), scale_x * (F16(R[1]) - slope_x * F16(R[7])),
          scale_x * (F16(R[2]) - slope_x * F16(R[8]))};
  m[1] = {scale_y * (F16(R[3]) - slope_y * F16(R[6])), scale_y * (F16(R[4]) - slope_y * F16(R[7])),
          scale_y * (F16(R[5]) - slope_y * F16(R[8]))};
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

// Finishes the projection from P (2x3), where P P^T is the 2D covariance before blurring. Working
// from the factor keeps needles accurate: det(P P^T) = |p0 x p1|^2 needs no difference of products
// of large entries. Returns the lanes that are visible.
template <bool kDistorted = false>
SP_INLINE Mask16 finish_projection(const Camera& camera, const Vector16& p_C, const F16& inverse_z,
                                   Vector16 p0, Vector16 p1, F16 log2_opacity, SplatPack& out) {
  // Scaling by g keeps the squares of huge Gaussians within range; it is exactly 1 for all others.
  const F16 largest = max(max(largest_component(p0), largest_component(p1)), F16(1e8f));
  const F16 g = F16(1e8f) / largest;
  p0 = g * p0;
  p1 = g * p1;
  const F16 blur = F16(camera.eps2d) * g * g;
  const F16 raw00 = p0.x * p0.x + p0.y * p0.y + p0.z * p0.z;
  const F16 raw11 = p1.x * p1.x + p1.y * p1.y + p1.z * p1.z;
  const F16 s00 = raw00 + blur;
  const F16 s11 = raw11 + blur;
  const F16 s01 = p0.x * p1.x + p0.y * p1.y + p0.z * p1.z;
  const Vector16 c = cross(p0, p1);
  const F16 raw_det = c.x * c.x + c.y * c.y + c.z * c.z;
  const F16 det = raw_det + blur * (raw00 + raw11 + blur);
  if (camera.antialiased) {
    // What the blur adds to the area is taken from the opacity (Yu et al. 2024).
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
    visible = visible & has_place(camera.distortion, slope_x, slope_y, p);
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
    // Field by field: a whole row would wait for its parts.
    float* row = reinterpret_cast<float*>(splats + count);
    for (int f = 0; f < 14; ++f) row[f] = fields[f][lane];
    splats[count].index = indices[lane];
    std::memcpy(depth_bits + count, fields[11] + lane, sizeof(uint32_t));
    ++count;
  }
  return count;
}

}  // namespace splatpilot::SIMD_LEVEL
