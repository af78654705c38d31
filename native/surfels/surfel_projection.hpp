// Surfels in the world to rays through their planes, 16 at a time (Huang et al. 2024, section 4.2,
// with the homography between plane and image inverted in closed form).
#pragma once

#include "core/doubles.hpp"
#include "project/project_arrays.hpp"
#include "surfels/surfel_types.hpp"

namespace splatpilot::SIMD_LEVEL {

struct DoubleVector16 {
  D16 x, y, z;
};

SP_INLINE Vector16 to_float(const DoubleVector16& a) {
  return {to_float(a.x), to_float(a.y), to_float(a.z)};
}

SP_INLINE DoubleVector16 to_camera(const Camera& camera, const DoubleVector16& d_W) {
  const float* R = camera.R_CW;
  return {D16(R[0]) * d_W.x + (D16(R[1]) * d_W.y + D16(R[2]) * d_W.z),
          D16(R[3]) * d_W.x + (D16(R[4]) * d_W.y + D16(R[5]) * d_W.z),
          D16(R[6]) * d_W.x + (D16(R[7]) * d_W.y + D16(R[8]) * d_W.z)};
}

// A coordinate of world points relative to the camera center.
SP_INLINE D16 from_center(const Camera& camera, const F16& p_W, int axis) {
  return D16(p_W) - D16(static_cast<double>(camera.center_high[axis]) + camera.center_low[axis]);
}

// The unit tangents of surfels in the world: the first columns of R(q).
SP_INLINE void surfel_tangents(const F16 q[4], DoubleVector16 t[2]) {
  const D16 w(q[0]), x(q[1]), y(q[2]), z(q[3]), one = 1.0;
  const D16 two = D16(2.0) / ((w * w + x * x) + (y * y + z * z));
  t[0] = {one - two * (y * y + z * z), two * (x * y + w * z), two * (x * z - w * y)};
  t[1] = {two * (x * y - w * z), one - two * (x * x + z * z), two * (y * z + w * x)};
}

// A surfel in the camera frame, and the coefficients of Surfel::u, v and w before the division by
// focal lengths: u = (t1 x p) / (s0 n . p), v = (p x t0) / (s1 n . p), w = n / (n . p), of which
// the x and y components count.
struct SurfelPlane {
  Vector16 p, t[3], t_W[3];  // t[2] = t[0] x t[1] is the normal n
  F16 facing;                // n . p
  F16 inverse_facing;
  Vector16 u, v, w;
  F16 mean[2], rest[2];  // the center's pixel is their sum [px]
  Mask16 edge_on;
};

// In doubles up to the differences that cancel as n . p goes to zero: a float's error of p or n, or
// of the pixel against the width of the ellipse, is that error over the sine in every gradient.
SP_INLINE SurfelPlane surfel_plane(const Camera& camera, const GatheredGaussians& in) {
  DoubleVector16 t_W[2];
  surfel_tangents(in.quat, t_W);
  const DoubleVector16 t[2] = {to_camera(camera, t_W[0]), to_camera(camera, t_W[1])};
  const DoubleVector16 p =
      to_camera(camera, {from_center(camera, in.mean.x, 0), from_center(camera, in.mean.y, 1),
                         from_center(camera, in.mean.z, 2)});
  const DoubleVector16 n = cross(t[0], t[1]);
  SurfelPlane s;
  s.p = to_float(p);
  for (int k = 0; k < 2; ++k) s.t[k] = to_float(t[k]);
  for (int k = 0; k < 2; ++k) s.t_W[k] = to_float(t_W[k]);
  s.t[2] = to_float(n);
  s.t_W[2] = to_float(cross(t_W[0], t_W[1]));
  s.facing = to_float(n.x * p.x + (n.y * p.y + n.z * p.z));
  s.edge_on = s.facing * s.facing <= F16(kEdgeOn * kEdgeOn) * dot(s.p, s.p);
  s.inverse_facing = F16(1.0f) / select(s.edge_on, F16(1.0f), s.facing);
  s.u = (s.inverse_facing / in.scale[0]) * to_float(cross(t[1], p));
  s.v = (s.inverse_facing / in.scale[1]) * to_float(cross(p, t[0]));
  s.w = s.inverse_facing * s.t[2];
  const D16 inverse_z = D16(1.0) / p.z;
  const D16 mean[2] = {D16(camera.fx) * (p.x * inverse_z) + D16(camera.cx),
                       D16(camera.fy) * (p.y * inverse_z) + D16(camera.cy)};
  for (int k = 0; k < 2; ++k) {
    s.mean[k] = to_float(mean[k]);
    s.rest[k] = to_float(mean[k] - D16(s.mean[k]));
  }
  return s;
}

// Where alpha can reach the cut: the image of the disc of radius r standard deviations about the
// center, an ellipse while the disc is beyond the near plane, and the blob. Returns the lanes of
// which some of it is on the image.
SP_INLINE Mask16 surfel_bounds(const Camera& camera, const SurfelPlane& s, const F16 scale[2],
                               const F16& log2_opacity, SplatPack& out, F16& disc_radius) {
  const F16 zero = F16(0.0f), one = F16(1.0f);
  const F16 budget = log2_opacity - F16(kLog2AlphaCut);
  const F16 r = sqrt(max(budget, zero) * F16(1.0f / kHalfLog2e));
  const F16 inverse_z = one / s.p.z;
  const F16 slope_x = s.p.x * inverse_z, slope_y = s.p.y * inverse_z;

  // A point (a, b) of the plane is seen at mean + (A (a, b)) / (z + c . (a, b)).
  F16 A_x[2], A_y[2], c[2];
  for (int k = 0; k < 2; ++k) {
    A_x[k] = scale[k] * F16(camera.fx) * (s.t[k].x - slope_x * s.t[k].z);
    A_y[k] = scale[k] * F16(camera.fy) * (s.t[k].y - slope_y * s.t[k].z);
    c[k] = scale[k] * s.t[k].z;
  }
  const F16 reach = r * sqrt(c[0] * c[0] + c[1] * c[1]);
  const Mask16 beyond = s.p.z - reach >= F16(camera.near_plane);
  // Dual of the conic, about the mean: an ellipse centered at -r^2 A c / d with the covariance
  // (outer product of that) + r^2 A A^T / d, d = z^2 - r^2 |c|^2.
  const F16 inverse_d = one / select(beyond, (s.p.z - reach) * (s.p.z + reach), one);
  const F16 offset_scale = -(r * r * inverse_d);
  const F16 offset_x = offset_scale * (A_x[0] * c[0] + A_x[1] * c[1]);
  const F16 offset_y = offset_scale * (A_y[0] * c[0] + A_y[1] * c[1]);
  const F16 size = r * sqrt(inverse_d);
  const F16 x0 = size * A_x[0], x1 = size * A_x[1], y0 = size * A_y[0], y1 = size * A_y[1];
  // A hundredth of a pixel keeps ellipses that have no width invertible.
  const F16 margin = F16(1e-4f);
  const F16 raw_xx = offset_x * offset_x + (x0 * x0 + x1 * x1);
  const F16 raw_yy = offset_y * offset_y + (y0 * y0 + y1 * y1);
  const F16 xx = raw_xx + margin, yy = raw_yy + margin;
  const F16 xy = offset_x * offset_y + (x0 * y0 + x1 * y1);
  const F16 d0 = offset_x * y0 - offset_y * x0, d1 = offset_x * y1 - offset_y * x1;
  const F16 d2 = x0 * y1 - x1 * y0;
  const F16 det = (d0 * d0 + d1 * d1 + d2 * d2) + margin * (raw_xx + raw_yy + margin);

  // Scaled so that u^2 + v^2 = log2(255 o) on the ellipse, as touched_blocks() has it. A disc that
  // is cut by the near plane is bounded by a rectangle, in which u = v = 0.
  const F16 root = sqrt(max(budget, zero));
  const F16 ellipse_ux = root * sqrt(yy / det), inverse_yy = one / yy;
  const Mask16 regular = beyond & (ellipse_ux < F16(1e30f)) & (xx + yy < F16(1e15f));
  const F16 cut_x = r * sqrt(A_x[0] * A_x[0] + A_x[1] * A_x[1]) / F16(camera.near_plane);
  const F16 cut_y = r * sqrt(A_y[0] * A_y[0] + A_y[1] * A_y[1]) / F16(camera.near_plane);
  const F16 most = F16(1e30f);
  out.mean_x = s.mean[0] + zero_unless(regular, offset_x);
  out.mean_y = s.mean[1] + zero_unless(regular, offset_y);
  // min() returns its second operand for a NaN.
  out.extent_x = min(select(regular, sqrt(xx), cut_x), most);
  out.extent_y = min(select(regular, sqrt(yy), cut_y), most);
  out.slope_x = zero_unless(regular, xy * inverse_yy);
  out.slope_y = zero_unless(regular, xy / xx);
  out.ux = zero_unless(regular, ellipse_ux);
  out.uy = -(out.ux * out.slope_x);
  out.vy = zero_unless(regular, root * sqrt(inverse_yy));
  out.log2_opacity = log2_opacity;
  out.depth = s.p.z;
  disc_radius = r * F16(__builtin_sqrtf(kBlobVariance));

  const F16 low_x = min(out.mean_x - out.extent_x, s.mean[0] - disc_radius);
  const F16 high_x = max(out.mean_x + out.extent_x, s.mean[0] + disc_radius);
  const F16 low_y = min(out.mean_y - out.extent_y, s.mean[1] - disc_radius);
  const F16 high_y = max(out.mean_y + out.extent_y, s.mean[1] + disc_radius);
  return in_depth_range(camera, s.p.z) & (budget >= zero) &
         (max(disc_radius, max(out.extent_x, out.extent_y)) > F16(camera.radius_clip)) &
         (high_x > zero) & (low_x < F16(static_cast<float>(camera.width))) & (high_y > zero) &
         (low_y < F16(static_cast<float>(camera.height)));
}

inline size_t project_surfels(const GaussianArrays& g, const Camera& camera, size_t begin,
                              size_t end, Splat* bounds, Surfel* surfels, uint32_t* depth_bits) {
  uint32_t candidates[kChunkSize + kLanes];
  // A disc of radius R reaches the half-space n . p > 0 if n . p + |n| R > 0; the sides have room
  // for the blob.
  float reach[4];
  for (int side = 0; side < 4; ++side) {
    const float* n = camera.side_normal[side];
    reach[side] = 1.001f * kMaxExtent * __builtin_sqrtf(n[0] * n[0] + n[1] * n[1] + n[2] * n[2]);
  }
  const size_t candidate_count = cull<2>(g, camera, reach, begin, end, candidates);
  size_t count = 0;
  for (size_t first = 0; first < candidate_count; first += kLanes) {
    const uint32_t* indices = candidates + first;
    const GatheredGaussians in = gather_gaussians(g, indices);
    const Vector16 d_W = from_center(camera, in.mean.x, in.mean.y, in.mean.z);
    const SurfelPlane s = surfel_plane(camera, in);
    const F16 log2_opacity = log2(max(in.opacity, F16(1e-30f)));
    SplatPack pack;
    F16 disc[3], color[3];
    uint32_t bits = lane_bits(surfel_bounds(camera, s, in.scale, log2_opacity, pack, disc[2]));
    if (candidate_count - first < kLanes) bits &= (1u << (candidate_count - first)) - 1;
    if (!bits) continue;
    gather_colors(g, indices, bits, d_W, color);

    disc[0] = s.mean[0];
    disc[1] = s.mean[1];
    const F16 inverse_fx = F16(1.0f / camera.fx), inverse_fy = F16(1.0f / camera.fy);
    const F16 zero = F16(0.0f), one = F16(1.0f);
    const F16 toward = select(s.facing > zero, -one, one);
    F16 rows[3][3];  // u, v and w
    const Vector16* planes[3] = {&s.u, &s.v, &s.w};
    for (int i = 0; i < 3; ++i) {
      rows[i][0] = select(s.edge_on, zero, planes[i]->x * inverse_fx);
      rows[i][1] = select(s.edge_on, zero, planes[i]->y * inverse_fy);
      rows[i][2] = -(rows[i][0] * s.rest[0] + rows[i][1] * s.rest[1]);
    }
    rows[2][2] = select(s.edge_on, -one, rows[2][2] + one / s.p.z);
    const F16 fields[kSurfelFields] = {s.mean[0],
                                       s.mean[1],
                                       rows[0][0],
                                       rows[0][1],
                                       rows[0][2],
                                       rows[1][0],
                                       rows[1][1],
                                       rows[1][2],
                                       rows[2][0],
                                       rows[2][1],
                                       rows[2][2],
                                       s.p.z,
                                       log2_opacity,
                                       color[0],
                                       color[1],
                                       color[2],
                                       toward * s.t_W[2].x,
                                       toward * s.t_W[2].y,
                                       toward * s.t_W[2].z};
    alignas(64) float soa[kSurfelFields][kLanes];
    for (int f = 0; f < kSurfelFields; ++f) store(soa[f], fields[f]);
    size_t next = count;
    for (uint32_t b = bits; b; b &= b - 1, ++next) {
      const int lane = __builtin_ctz(b);
      float row[kSurfelFields];
      for (int f = 0; f < kSurfelFields; ++f) row[f] = soa[f][lane];
      std::memcpy(surfels + next, row, sizeof(Surfel));
    }
    count += append_splats(pack, disc, bits, indices, bounds + count, depth_bits + count);
  }
  return count;
}

}  // namespace splatpilot::SIMD_LEVEL
