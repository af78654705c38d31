// From Gaussians in the world to splats on the image plane (EWA projection; Zwicker et al. 2001,
// Kerbl et al. 2023), 16 at a time.
#pragma once

#include "mathematics.hpp"
#include "spherical_harmonics.hpp"
#include "types.hpp"

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

SP_INLINE F16 dot(const Vector16& a, const Vector16& b) {
  return a.x * b.x + a.y * b.y + a.z * b.z;
}

// Row i of R_CW: the camera's axis i in the world.
SP_INLINE Vector16 camera_axis(const Camera& camera, int i) {
  const float* row = camera.R_CW + 3 * i;
  return {F16(row[0]), F16(row[1]), F16(row[2])};
}

// p_W relative to the camera centre, still in world axes.
SP_INLINE Vector16 from_centre(const Camera& camera, const F16& x, const F16& y, const F16& z) {
  return {(x - F16(camera.centre_high[0])) - F16(camera.centre_low[0]),
          (y - F16(camera.centre_high[1])) - F16(camera.centre_low[1]),
          (z - F16(camera.centre_high[2])) - F16(camera.centre_low[2])};
}

SP_INLINE Vector16 to_camera(const Camera& camera, const Vector16& d_W) {
  return {dot(camera.R_CW, d_W), dot(camera.R_CW + 3, d_W), dot(camera.R_CW + 6, d_W)};
}

SP_INLINE Mask16 in_depth_range(const Camera& camera, const F16& z) {
  return (z >= F16(camera.near_plane)) & (z <= F16(camera.far_plane));
}

// Lanes whose Gaussians may touch the image, judged by position and largest scale alone.
SP_INLINE Mask16 may_be_visible(const Camera& camera, const Vector16& p_C,
                                const F16& largest_scale) {
  Mask16 visible = in_depth_range(camera, p_C.z);
  for (int side = 0; side < 4; ++side) {
    const F16 reach = F16(camera.side_reach[side]) * largest_scale;
    visible = visible & (dot(camera.side_normal[side], p_C) + reach > F16(0.0f));
  }
  return visible;
}

// The image of the world axes under the projection's Jacobian at p_C: m[i] = J_i R_CW, with the
// slopes x/z and y/z held within 1.3 times the field of view as in the original method.
SP_INLINE void projection_rows(const Camera& camera, const Vector16& p_C, const F16& inverse_z,
                               Vector16 m[2]) {
  const F16 slope_x = clamp(p_C.x * inverse_z, F16(camera.min_slope_x), F16(camera.max_slope_x));
  const F16 slope_y = clamp(p_C.y * inverse_z, F16(camera.min_slope_y), F16(camera.max_slope_y));
  const F16 scale_x = F16(camera.fx) * inverse_z;
  const F16 scale_y = F16(camera.fy) * inverse_z;
  const float* R = camera.R_CW;
  m[0] = {scale_x * (F16(R[0]) - slope_x * F16(R[6])), scale_x * (F16(R[1]) - slope_x * F16(R[7])),
          scale_x * (F16(R[2]) - slope_x * F16(R[8]))};
  m[1] = {scale_y * (F16(R[3]) - slope_y * F16(R[6])), scale_y * (F16(R[4]) - slope_y * F16(R[7])),
          scale_y * (F16(R[5]) - slope_y * F16(R[8]))};
}

// The lanes whose slopes that holds back.
SP_INLINE Mask16 slopes_held(const Camera& camera, const Vector16& p_C, const F16& inverse_z) {
  const F16 x = p_C.x * inverse_z, y = p_C.y * inverse_z;
  const F16 beyond = max(max(F16(camera.min_slope_x) - x, x - F16(camera.max_slope_x)),
                         max(F16(camera.min_slope_y) - y, y - F16(camera.max_slope_y)));
  return beyond > F16(0.0f);
}

// Sixteen projected Gaussians, one pack per field of Splat.
struct SplatPack {
  F16 mean_x, mean_y, extent_x, extent_y, ux, uy, vy, log2_opacity, depth, slope_x, slope_y, reach;
};

// One pack per field of DepthPlane, and the lanes that the image shows a part of.
struct PlanePack {
  F16 ux, uy, vy, l_x, l_y, b_xx, b_xy, b_yy, inverse_z;
  Mask16 seen;
};

// From x, y and c, the camera's axes and the centre where the Gaussian is a unit sphere about c.
// With r = c / z + x dx / fx + y dy / fy for the ray, q and l are r.r and r.c over those of the
// centre, and the distance of c from the ray, squared, is |r x c|^2 / r.r.
SP_INLINE PlanePack depth_plane(const Camera& camera, const F16& z, const F16& inverse_z,
                                Vector16 x, Vector16 y, const Vector16& c) {
  const F16 least = F16(1e-20f), most = F16(1e6f);
  const F16 squared = max(dot(c, c), least);
  x = z * F16(1.0f / camera.fx) * x;
  y = z * F16(1.0f / camera.fy) * y;
  const F16 inverse = F16(1.0f) / squared;
  PlanePack out;
  out.inverse_z = inverse_z;
  out.l_x = inverse * dot(x, c);
  out.l_y = inverse * dot(y, c);
  out.b_xx = inverse * dot(x, x);
  out.b_xy = inverse * dot(x, y) * F16(2.0f);
  out.b_yy = inverse * dot(y, y);
  const Vector16 x_c = cross(x, c), y_c = cross(y, c);
  const F16 u2 = max(dot(x_c, x_c), least);
  const F16 triple = dot(x, y_c);  // |x_c x y_c| = |c| |triple|
  const F16 root = sqrt(u2);
  const F16 factor = F16(kExponentScale) * sqrt(inverse);
  out.ux = min(factor * root, most);
  out.uy = out.ux * (dot(x_c, y_c) / u2);
  out.vy = clamp(F16(kExponentScale) * sqrt(triple * triple / u2), F16(1e-6f), most);
  return out;
}

// How many times as far as a splat says a plane of it may touch pixels. n standard deviations from
// the centre, on an affine footprint, l - 1 is at most f and q - 2 l + 1 at most g, so that
// r^2 <= n^2 q, where alpha is above the cut, has an end if g < 1. `held` are the lanes whose splat
// is not that affine footprint with blur, for slopes held back.
SP_INLINE F16 reach_of(const PlanePack& p, const SplatPack& splat, const Mask16& held) {
  const F16 one = F16(1.0f), n = F16(kMaxExtent * kExponentScale);
  // The inverse of the footprint's factor, and f and g of each of its columns.
  const F16 a = one / p.ux, d = one / p.vy, b = -(p.uy * a * d);
  const F16 f1 = p.l_x * a, f2 = p.l_x * b + p.l_y * d;
  const F16 f = n * sqrt(f1 * f1 + f2 * f2);
  const F16 g = n * n * (p.b_xx * (a * a + b * b) + p.b_xy * (b * d) + p.b_yy * (d * d));
  const F16 rest = max(one - g, F16(1.0f / kMostReach));
  const F16 reach = (f + sqrt(f * f + rest)) / rest;
  const F16 s1 = splat.ux * a, s2 = splat.ux * b + splat.uy * d, s3 = splat.vy * d;
  const F16 stretch = select(held, max(s1 * s1 + s2 * s2 + s3 * s3, one), one);
  return select(p.seen, min(reach * sqrt(stretch), F16(kMostReach)), one);
}

// Lanes of which a part within kMaxExtent standard deviations is between the sides of the image.
// `times_factor(n)` is n times a factor of the covariance.
template <typename Times>
SP_INLINE Mask16 reaches_image(const Camera& camera, const Vector16& p_C,
                               const Times& times_factor) {
  Mask16 seen = in_depth_range(camera, p_C.z);
  for (int side = 0; side < 4; ++side) {
    const float* n_C = camera.side_normal[side];
    const float* R = camera.R_CW;
    const auto in_world = [&](int axis) {
      return F16(n_C[0] * R[axis] + n_C[1] * R[3 + axis] + n_C[2] * R[6 + axis]);
    };
    const Vector16 s = times_factor(Vector16{in_world(0), in_world(1), in_world(2)});
    seen = seen & (dot(n_C, p_C) + F16(kMaxExtent) * sqrt(dot(s, s)) > F16(0.0f));
  }
  return seen;
}

SP_INLINE F16 largest_component(const Vector16& a) {
  return max(max(max(a.x, -a.x), max(a.y, -a.y)), max(a.z, -a.z));
}

// Finishes the projection from P (2x3), where P P^T is the 2D covariance before blurring. Working
// from the factor keeps needles accurate: det(P P^T) = |p0 x p1|^2 needs no difference of products
// of large entries. With `plane`, it touches what that does too. Returns the lanes that are
// visible.
SP_INLINE Mask16 finish_projection(const Camera& camera, const Vector16& p_C, const F16& inverse_z,
                                   Vector16 p0, Vector16 p1, F16 log2_opacity,
                                   const PlanePack* plane, SplatPack& out) {
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
  Mask16 visible = in_depth_range(camera, p_C.z) & (budget >= F16(0.0f));
  visible = visible & (max(out.extent_x, out.extent_y) > clip);
  out.reach = F16(1.0f);
  if (plane) out.reach = reach_of(*plane, out, slopes_held(camera, p_C, inverse_z));
  const F16 reach_x = out.reach * out.extent_x, reach_y = out.reach * out.extent_y;
  visible = visible & (out.mean_x + reach_x > F16(0.0f)) & (out.mean_x - reach_x < width) &
            (out.mean_y + reach_y > F16(0.0f)) & (out.mean_y - reach_y < height);
  // An overflow somewhere leaves an infinity or a NaN in one of these.
  const F16 finite = (out.ux + out.vy) * F16(0.0f) + out.uy * F16(0.0f);
  return visible & (finite >= F16(0.0f));
}

// Appends the lanes in `bits`, in lane order.
SP_INLINE void append_planes(const PlanePack& p, uint32_t bits, DepthPlane* planes) {
  constexpr int kFields = 9;
  alignas(64) float fields[kFields][kLanes];
  const F16* packs[kFields] = {&p.ux,   &p.uy,   &p.vy,   &p.l_x,      &p.l_y,
                               &p.b_xx, &p.b_xy, &p.b_yy, &p.inverse_z};
  for (int f = 0; f < kFields; ++f) store(fields[f], *packs[f]);
  for (; bits; bits &= bits - 1, ++planes) {
    const int lane = __builtin_ctz(bits);
    float row[12] = {};
    for (int f = 0; f < kFields; ++f) row[f] = fields[f][lane];
    std::memcpy(planes, row, sizeof(DepthPlane));
  }
}

// Appends the lanes in `bits`, in lane order.
SP_INLINE size_t append_splats(const SplatPack& p, const F16 color[3], uint32_t bits,
                               const uint32_t* indices, Splat* splats, uint32_t* depth_bits) {
  constexpr int kIndex = 14;  // the field that is no float
  alignas(64) float fields[kLanes][kLanes];
  const F16* packs[kLanes] = {&p.mean_x,  &p.mean_y,  &p.extent_x, &p.extent_y,
                              &p.ux,      &p.uy,      &p.vy,       &p.log2_opacity,
                              color,      color + 1,  color + 2,   &p.depth,
                              &p.slope_x, &p.slope_y, &p.reach,    &p.reach};
  for (int f = 0; f < kLanes; ++f) store(fields[f], *packs[f]);
  size_t count = 0;
  for (; bits; bits &= bits - 1) {
    const int lane = __builtin_ctz(bits);
    alignas(64) float row[kLanes];
    for (int f = 0; f < kLanes; ++f) row[f] = fields[f][lane];
    std::memcpy(row + kIndex, indices + lane, sizeof(uint32_t));
    std::memcpy(splats + count, row, sizeof(Splat));
    std::memcpy(depth_bits + count, row + 11, sizeof(uint32_t));
    ++count;
  }
  return count;
}

}  // namespace splatpilot::SIMD_LEVEL
