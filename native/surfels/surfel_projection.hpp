// Projection of surfels to rays through their planes, 16 at a time (Huang et al. 2024, section 4.2,
// with a closed-form inverse of the homography between plane and image), and its derivatives.
#pragma once

#include "backward/projection_backward.hpp"
#include "surfels/surfel_types.hpp"

namespace splatpilot::SIMD_LEVEL {

SP_INLINE Vector16 to_float(const DoubleVector16& a) {
  return {to_float(a.x), to_float(a.y), to_float(a.z)};
}

// A coordinate of world points relative to the camera center.
SP_INLINE D16 from_center(const Camera& camera, const F16& p_W, int axis) {
  return D16(p_W) - D16(static_cast<double>(camera.center_high[axis]) + camera.center_low[axis]);
}

// A surfel in the camera frame, and the coefficients of Surfel::u, v and w before the division by
// focal lengths: u = (t1 x p) / (s0 n . p), v = (p x t0) / (s1 n . p), w = n / (n . p). Their z
// components are not used.
struct SurfelPlane {
  Vector16 p, t[3], t_W[3];  // t[2] = t[0] x t[1] is the normal n
  F16 facing;                // n . p
  F16 inverse_facing;
  Vector16 u, v, w;
  F16 mean[2], rest[2];  // the center's pixel is their sum [px]
  Mask16 edge_on;
};

// Doubles, up to the differences that cancel as n . p goes to zero, where the errors of floats
// would be amplified in every gradient.
SP_INLINE SurfelPlane surfel_plane(const Camera& camera, const PackedGaussians& in) {
  DoubleVector16 t_W[3];
  const D16 quat[4] = {D16(in.quat[0]), D16(in.quat[1]), D16(in.quat[2]), D16(in.quat[3])};
  rotation_columns(quat, t_W);
  const DoubleVector16 t[2] = {to_camera(camera, t_W[0]), to_camera(camera, t_W[1])};
  const DoubleVector16 d_W = {from_center(camera, in.mean.x, 0), from_center(camera, in.mean.y, 1),
                              from_center(camera, in.mean.z, 2)};
  const DoubleVector16 p = to_camera(camera, d_W);
  const DoubleVector16 n = cross(t[0], t[1]);
  SurfelPlane s;
  s.p = to_float(p);
  for (int k = 0; k < 2; ++k) s.t[k] = to_float(t[k]);
  for (int k = 0; k < 3; ++k) s.t_W[k] = to_float(t_W[k]);
  s.t[2] = to_float(n);
  s.facing = to_float(dot(n, p));
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

// Bounds the region where alpha reaches the cut: the image of the disc of radius r standard
// deviations, an ellipse while the disc is beyond the near plane, and the blob. Returns the lanes
// with some of it on the image.
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
  // A hundredth of a pixel keeps ellipses without width invertible.
  const F16 margin = F16(1e-4f);
  const F16 raw_xx = offset_x * offset_x + (x0 * x0 + x1 * x1);
  const F16 raw_yy = offset_y * offset_y + (y0 * y0 + y1 * y1);
  const F16 xx = raw_xx + margin, yy = raw_yy + margin;
  const F16 xy = offset_x * offset_y + (x0 * y0 + x1 * y1);
  const F16 d0 = offset_x * y0 - offset_y * x0, d1 = offset_x * y1 - offset_y * x1;
  const F16 d2 = x0 * y1 - x1 * y0;
  const F16 det = (d0 * d0 + d1 * d1 + d2 * d2) + margin * (raw_xx + raw_yy + margin);

  // Scaled so that u^2 + v^2 = log2(255 o) on the ellipse, as for touched_blocks(). A disc cut by
  // the near plane is bounded by a rectangle with u = v = 0.
  const F16 root = sqrt(max(budget, zero));
  const F16 ellipse_ux = root * sqrt(yy / det), inverse_yy = one / yy;
  const Mask16 regular = beyond & (ellipse_ux < F16(1e30f)) & (xx + yy < F16(1e15f));
  const F16 cut_x = r * sqrt(A_x[0] * A_x[0] + A_x[1] * A_x[1]) / F16(camera.near_plane);
  const F16 cut_y = r * sqrt(A_y[0] * A_y[0] + A_y[1] * A_y[1]) / F16(camera.near_plane);
  const F16 largest = F16(1e30f);
  out.mean_x = s.mean[0] + zero_unless(regular, offset_x);
  out.mean_y = s.mean[1] + zero_unless(regular, offset_y);
  // min() returns its second operand for a NaN.
  out.extent_x = min(select(regular, sqrt(xx), cut_x), largest);
  out.extent_y = min(select(regular, sqrt(yy), cut_y), largest);
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
  // A disc of radius R reaches the half-space n . p > 0 if n . p + |n| R > 0.
  float reach[4];
  for (int side = 0; side < 4; ++side) {
    reach[side] = 1.001f * kMaxExtent * length(camera.side_normal[side]);
  }
  const auto project = [&](const PackedGaussians& in, const uint32_t* indices, uint32_t lanes,
                           size_t count) -> size_t {
    const Vector16 d_W = from_center(camera, in.mean.x, in.mean.y, in.mean.z);
    const SurfelPlane s = surfel_plane(camera, in);
    const F16 opacity = log2_opacity(in), zero = F16(0.0f), one = F16(1.0f);
    SplatPack pack;
    F16 disc[3], color[3];
    const uint32_t bits =
        lane_bits(surfel_bounds(camera, s, in.scale, opacity, pack, disc[2])) & lanes;
    if (!bits) return 0;
    load_colors(g, indices, bits, d_W, color);
    disc[0] = s.mean[0];
    disc[1] = s.mean[1];
    const F16 inverse_fx = F16(1.0f / camera.fx), inverse_fy = F16(1.0f / camera.fy);
    const F16 toward = select(s.facing > zero, -one, one);
    F16 rows[3][3];  // u, v and w
    const Vector16* planes[3] = {&s.u, &s.v, &s.w};
    for (int i = 0; i < 3; ++i) {
      rows[i][0] = select(s.edge_on, zero, planes[i]->x * inverse_fx);
      rows[i][1] = select(s.edge_on, zero, planes[i]->y * inverse_fy);
      rows[i][2] = -(rows[i][0] * s.rest[0] + rows[i][1] * s.rest[1]);
    }
    rows[2][2] = select(s.edge_on, -one, rows[2][2] + one / s.p.z);
    const Vector16 normal = toward * s.t_W[2];
    const F16* fields[kSurfelFields] = {
        s.mean,      s.mean + 1, rows[0],     rows[0] + 1, rows[0] + 2, rows[1],  rows[1] + 1,
        rows[1] + 2, rows[2],    rows[2] + 1, rows[2] + 2, &s.p.z,      &opacity, color,
        color + 1,   color + 2,  &normal.x,   &normal.y,   &normal.z};
    alignas(64) float soa[kSurfelFields][kLanes];
    for (int f = 0; f < kSurfelFields; ++f) store(soa[f], *fields[f]);
    Surfel* next = surfels + count;
    for (uint32_t b = bits; b; b &= b - 1, ++next) {
      const int lane = __builtin_ctz(b);
      float row[kSurfelFields];
      for (int f = 0; f < kSurfelFields; ++f) row[f] = soa[f][lane];
      std::memcpy(next, row, sizeof(Surfel));
    }
    return append_splats(pack, disc, bits, indices, bounds + count, depth_bits + count);
  };
  return project_candidates<2>(g, camera, reach, begin, end, project);
}

SP_INLINE Vector16 zero_unless(const Mask16& m, const Vector16& a) {
  return {zero_unless(m, a.x), zero_unless(m, a.y), zero_unless(m, a.z)};
}

// The gradient by a surfel's center and tangents in the camera frame, and by its scales.
struct PlaneGradient {
  Vector16 p, t[2];
  F16 scale[2];
};

SP_INLINE PlaneGradient plane_gradient(const Camera& camera, const SurfelPlane& s,
                                       const F16 scale[2], const F16 g[16]) {
  const F16 zero = F16(0.0f);
  const F16 inverse_s0 = F16(1.0f) / scale[0], inverse_s1 = F16(1.0f) / scale[1];
  const F16 inverse_z = F16(1.0f) / s.p.z;
  // d = A (u . d, v . d), with A the image of the scaled tangents; without focal lengths.
  Vector16 A[2];
  for (int k = 0; k < 2; ++k) {
    A[k] = {scale[k] * (s.t[k].x - s.p.x * inverse_z * s.t[k].z),
            scale[k] * (s.t[k].y - s.p.y * inverse_z * s.t[k].z), zero};
  }
  const Vector16 by_u0 = g[0] * A[0] + g[1] * A[1];
  const Vector16 by_v0 = g[2] * A[0] + g[3] * A[1];
  const Vector16 by_w = g[4] * A[0] + g[5] * A[1];
  // Derivatives with respect to the logarithms of common factors; w . A[k] is -scale t.z / p.z.
  const F16 by_log_u = g[0], by_log_v = g[3];
  const F16 by_log_w = -((g[4] * scale[0] * s.t[0].z + g[5] * scale[1] * s.t[1].z) * inverse_z);
  const F16 u_factor = s.inverse_facing * inverse_s0, v_factor = s.inverse_facing * inverse_s1;
  const Vector16 by_u = u_factor * by_u0;  // of t1 x p
  const Vector16 by_v = v_factor * by_v0;  // of p x t0
  const F16 by_facing = -((by_log_u + by_log_v + by_log_w) * s.inverse_facing);
  const Vector16 by_n = s.inverse_facing * by_w + by_facing * s.p;

  PlaneGradient out;
  out.p = by_facing * s.t[2] + (cross(by_u, s.t[1]) + cross(s.t[0], by_v));
  out.t[0] = cross(by_v, s.p) + cross(s.t[1], by_n);
  out.t[1] = cross(s.p, by_u) + cross(by_n, s.t[0]);
  out.scale[0] = -(by_log_u * inverse_s0);
  out.scale[1] = -(by_log_v * inverse_s1);
  // No ray meets a surfel seen edge-on.
  const Mask16 met = s.facing * s.facing > F16(kEdgeOn * kEdgeOn) * dot(s.p, s.p);
  out.p = zero_unless(met, out.p);
  for (int k = 0; k < 2; ++k) {
    out.t[k] = zero_unless(met, out.t[k]);
    out.scale[k] = zero_unless(met, out.scale[k]);
  }

  const F16 by_x = g[6] * F16(camera.fx) * inverse_z, by_y = g[7] * F16(camera.fy) * inverse_z;
  out.p = out.p + Vector16{by_x, by_y, g[8] - (by_x * s.p.x + by_y * s.p.y) * inverse_z};
  return out;
}

inline void project_surfels_backward(const GaussianArrays& input, const Camera& camera,
                                     const uint32_t* all_indices, const SurfelGradient* gradients,
                                     size_t count, const GaussianGradients& out, PoseSums* pose) {
  PoseGradientPack pose_pack;
  for (size_t first = 0; first < count; first += kLanes) {
    const size_t lanes = count - first < kLanes ? count - first : kLanes;
    const uint32_t bits = (1u << lanes) - 1;
    uint32_t indices[kLanes];
    alignas(64) float soa[16][kLanes] = {};
    for (size_t lane = 0; lane < kLanes; ++lane) {
      indices[lane] = all_indices[first + (lane < lanes ? lane : 0)];
      if (lane >= lanes) continue;
      float row[16];
      std::memcpy(row, gradients + first + lane, sizeof(row));
      for (int f = 0; f < 16; ++f) soa[f][lane] = row[f];
    }
    F16 g[16];
    for (int f = 0; f < 16; ++f) g[f] = load(soa[f]);

    const PackedGaussians in = load_gaussians(input, indices);
    const Vector16 d_W = from_center(camera, in.mean.x, in.mean.y, in.mean.z);
    const SurfelPlane s = surfel_plane(camera, in);
    const Vector16* t_W = s.t_W;
    const PlaneGradient by = plane_gradient(camera, s, in.scale, g);

    const F16 one = F16(1.0f), zero = F16(0.0f);
    const F16 toward = select(s.facing > zero, -one, one);
    const Vector16 by_normal = {toward * g[13], toward * g[14], toward * g[15]};
    const Vector16 by_t0 = to_world(camera, by.t[0]) + cross(t_W[1], by_normal);
    const Vector16 by_t1 = to_world(camera, by.t[1]) + cross(by_normal, t_W[0]);
    F16 by_color[3] = {g[10], g[11], g[12]};
    if (input.sh_degree >= 0) {
      // Colors clamped at zero do not change with their coefficients.
      F16 color[3];
      load_colors(input, indices, bits, d_W, color);
      for (int c = 0; c < 3; ++c) by_color[c] = zero_unless(color[c] > zero, by_color[c]);
    }
    const Vector16 by_d =
        colors_backward(input, indices, static_cast<int>(lanes), d_W, by_color, out.colors);
    const Vector16 none = {zero, zero, zero};
    GaussianGradientPack pack{to_world(camera, by.p) + by_d,
                              {},
                              {by.scale[0], by.scale[1], zero},
                              g[9] / max(in.opacity, F16(1e-30f))};
    quaternion_gradient(in.quat, by_t0, by_t1, none, pack.quat);
    add_rows(pack, indices, static_cast<int>(lanes), out);

    pose_pack.add(by.p, d_W, by_d);  // t_C = R t_W
    for (int k = 0; k < 2; ++k) {
      pose_pack.R[0] = pose_pack.R[0] + by.t[k].x * t_W[k];
      pose_pack.R[1] = pose_pack.R[1] + by.t[k].y * t_W[k];
      pose_pack.R[2] = pose_pack.R[2] + by.t[k].z * t_W[k];
    }
  }
  pose_pack.write(pose);
}

}  // namespace splatpilot::SIMD_LEVEL
