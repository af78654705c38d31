// From gradients of surfels to those of the input and of the camera.
#pragma once

#include "backward/color_backward.hpp"
#include "surfels/surfel_projection.hpp"

namespace splatpilot::SIMD_LEVEL {

// A gradient in the camera frame, in the world.
SP_INLINE Vector16 to_world(const Camera& camera, const Vector16& c) {
  const float* R = camera.R_CW;
  return {F16(R[0]) * c.x + F16(R[3]) * c.y + F16(R[6]) * c.z,
          F16(R[1]) * c.x + F16(R[4]) * c.y + F16(R[7]) * c.z,
          F16(R[2]) * c.x + F16(R[5]) * c.y + F16(R[8]) * c.z};
}

SP_INLINE Vector16 zero_unless(const Mask16& m, const Vector16& a) {
  return {zero_unless(m, a.x), zero_unless(m, a.y), zero_unless(m, a.z)};
}

// The gradient with respect to a quaternion of any length, from those of the first two columns of
// its rotation matrix.
SP_INLINE void quaternion_gradient(const F16 raw[4], const Vector16& a, const Vector16& b,
                                   F16 gradient[4]) {
  const F16 inverse_norm =
      F16(1.0f) / sqrt(raw[0] * raw[0] + raw[1] * raw[1] + raw[2] * raw[2] + raw[3] * raw[3]);
  const F16 two = F16(2.0f);
  const F16 w = raw[0] * inverse_norm, x = raw[1] * inverse_norm, y = raw[2] * inverse_norm,
            z = raw[3] * inverse_norm;
  gradient[0] = two * ((z * a.y - y * a.z) + (x * b.z - z * b.x));
  gradient[1] = two * ((y * a.y + z * a.z) + (y * b.x + w * b.z) - two * x * b.y);
  gradient[2] = two * ((x * a.y - w * a.z) + (x * b.x + z * b.z) - two * y * a.x);
  gradient[3] = two * ((w * a.y + x * a.z) + (y * b.z - w * b.x) - two * z * (a.x + b.y));
  const F16 along = gradient[0] * w + gradient[1] * x + gradient[2] * y + gradient[3] * z;
  const F16 unit[4] = {w, x, y, z};
  for (int k = 0; k < 4; ++k) gradient[k] = (gradient[k] - along * unit[k]) * inverse_norm;
}

// What a gradient of the surfel's fields is in the camera frame, with respect to its centre and its
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

// Sums of 16 lanes, of which those not in `bits` are left out.
SP_INLINE double masked_sum(const F16& a, uint32_t bits) {
  alignas(64) float lanes[kLanes];
  store(lanes, a);
  double total = 0.0;
  for (; bits; bits &= bits - 1) total += static_cast<double>(lanes[__builtin_ctz(bits)]);
  return total;
}

inline void project_surfels_backward(const GaussianArrays& input, const Camera& camera,
                                     const uint32_t* all_indices, const SurfelGradient* gradients,
                                     size_t count, const InputGradients& out,
                                     CameraGradient* by_camera) {
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
    const Vector16 d_W = from_centre(camera, in.mean.x, in.mean.y, in.mean.z);
    const SurfelPlane s = surfel_plane(camera, in);
    const Vector16* t_W = s.t_W;
    const PlaneGradient by = plane_gradient(camera, s, in.scale, g);

    const F16 one = F16(1.0f), zero = F16(0.0f);
    const F16 towards = select(s.facing > zero, -one, one);
    const Vector16 by_normal = {towards * g[13], towards * g[14], towards * g[15]};
    const Vector16 by_t0 = to_world(camera, by.t[0]) + cross(t_W[1], by_normal);
    const Vector16 by_t1 = to_world(camera, by.t[1]) + cross(by_normal, t_W[0]);
    F16 by_color[3] = {g[10], g[11], g[12]};
    if (input.sh_degree >= 0) {
      // Colours held at zero do not follow their coefficients.
      F16 color[3];
      gather_colors(input, indices, bits, d_W, color);
      for (int c = 0; c < 3; ++c) by_color[c] = zero_unless(color[c] > zero, by_color[c]);
    }
    const Vector16 by_d =
        colors_backward(input, indices, static_cast<int>(lanes), d_W, by_color, out.colors);
    const Vector16 by_p = to_world(camera, by.p) + by_d;

    F16 rows[10] = {by_p.x, by_p.y, by_p.z,      zero,        zero,
                    zero,   zero,   by.scale[0], by.scale[1], g[9] / max(in.opacity, F16(1e-30f))};
    quaternion_gradient(in.quat, by_t0, by_t1, rows + 3);
    alignas(64) float fields[10][kLanes];
    for (int f = 0; f < 10; ++f) store(fields[f], rows[f]);
    for (size_t lane = 0; lane < lanes; ++lane) {
      const size_t i = indices[lane];
      for (int k = 0; k < 3; ++k) out.means[3 * i + k] += fields[k][lane];
      for (int k = 0; k < 4; ++k) out.quats[4 * i + k] += fields[3 + k][lane];
      for (int k = 0; k < 2; ++k) out.scales[3 * i + k] += fields[7 + k][lane];
      out.opacities[i] += fields[9][lane];
    }

    if (!by_camera) continue;
    // p_C = R p_W + t and t_C = R t_W.
    const F16 p_W[3] = {in.mean.x, in.mean.y, in.mean.z};
    const F16 t0_W[3] = {t_W[0].x, t_W[0].y, t_W[0].z}, t1_W[3] = {t_W[1].x, t_W[1].y, t_W[1].z};
    const F16 by_p_C[3] = {by.p.x, by.p.y, by.p.z};
    const F16 by_t0_C[3] = {by.t[0].x, by.t[0].y, by.t[0].z};
    const F16 by_t1_C[3] = {by.t[1].x, by.t[1].y, by.t[1].z};
    const F16 by_centre[3] = {-by_d.x, -by_d.y, -by_d.z};
    for (int i = 0; i < 3; ++i) {
      for (int j = 0; j < 3; ++j) {
        by_camera->R[3 * i + j] +=
            masked_sum(by_p_C[i] * p_W[j] + (by_t0_C[i] * t0_W[j] + by_t1_C[i] * t1_W[j]), bits);
      }
      by_camera->t[i] += masked_sum(by_p_C[i], bits);
      by_camera->centre[i] += masked_sum(by_centre[i], bits);
    }
  }
}

}  // namespace splatpilot::SIMD_LEVEL
