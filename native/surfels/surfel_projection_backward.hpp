// From gradients of surfels to those of the input and of the camera.
#pragma once

#include "backward/projection_backward.hpp"
#include "surfels/surfel_projection.hpp"

namespace splatpilot::SIMD_LEVEL {

SP_INLINE Vector16 zero_unless(const Mask16& m, const Vector16& a) {
  return {zero_unless(m, a.x), zero_unless(m, a.y), zero_unless(m, a.z)};
}

// What a gradient of the surfel's fields is in the camera frame, with respect to its center and its
// tangents, and with respect to its scales.
struct PlaneGradient {
  Vector16 p, t[2];
  F16 scale[2];
};

SP_INLINE PlaneGradient plane_gradient(const Camera& camera, const SurfelPlane& s,
                                       const F16 scale[2], const F16 g[16]) {
  const F16 zero = F16(0.0f);
  const F16 inverse_s0 = F16(1.0f) / scale[0], inverse_s1 = F16(1.0f) / scale[1];
  const F16 inverse_z = F16(1.0f) / s.p.z;
  // d = A (u . d, v . d), with A the image of the scaled tangents; by focal lengths both ways.
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

    const GatheredGaussians in = gather_gaussians(input, indices);
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
      // Colors held at zero do not follow their coefficients.
      F16 color[3];
      gather_colors(input, indices, bits, d_W, color);
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
