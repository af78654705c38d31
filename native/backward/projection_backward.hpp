// The derivatives of project_gaussians.hpp, 16 Gaussians at a time.
#pragma once

#include "project/project_gaussians.hpp"

namespace splatpilot::SIMD_LEVEL {

// Adds to rows of dL/dcolors and returns dL/d(p_W - center), which is zero without spherical
// harmonics. `color_gradient` is zero where a color is clamped at 0.
SP_INLINE Vector16 colors_backward(const GaussianArrays& g, const uint32_t* indices, int lanes,
                                   const Vector16& d_W, const F16 color_gradient[3],
                                   float* gradients) {
  alignas(64) float soa[48][kLanes];
  if (g.sh_degree < 0) {
    for (int c = 0; c < 3; ++c) store(soa[c], color_gradient[c]);
    for (int lane = 0; lane < lanes; ++lane) {
      float* row = gradients + 3 * static_cast<size_t>(indices[lane]);
      for (int c = 0; c < 3; ++c) row[c] += soa[c][lane];
    }
    return {F16(0.0f), F16(0.0f), F16(0.0f)};
  }
  const int used = 3 * (g.sh_degree + 1) * (g.sh_degree + 1);
  const size_t stride = 3 * static_cast<size_t>(g.sh_coefficients);
  prefetch_rows(gradients, static_cast<int>(stride), used, indices, (1u << lanes) - 1);
  for (int lane = 0; lane < kLanes; ++lane) {
    const float* row = g.colors + stride * indices[lane];
    for (int k = 0; k < used; ++k) soa[k][lane] = row[k];
  }
  F16 direction[3] = {F16(0.0f), F16(0.0f), F16(0.0f)};
  evaluate_sh_backward(g.sh_degree, soa[0], d_W.x, d_W.y, d_W.z, color_gradient, direction);
  for (int lane = 0; lane < lanes; ++lane) {
    float* row = gradients + stride * indices[lane];
    for (int k = 0; k < used; ++k) row[k] += soa[k][lane];
  }
  return {direction[0], direction[1], direction[2]};
}

// From a gradient in the camera frame to the same in the world.
SP_INLINE Vector16 to_world(const Camera& camera, const Vector16& c) {
  const float* R = camera.R_CW;
  return c.x * broadcast(R) + (c.y * broadcast(R + 3) + c.z * broadcast(R + 6));
}

// Splats and their gradients, one pack per field.
struct SplatGradientPack {
  F16 ux, uy, vy;
  F16 mean_x, mean_y, log_opacity, uu, uv, vv, color[3], depth;
};

// dL/dP from the sums over pixels. With W = (ux uy; 0 vy) and A = W P, the covariance's gradient is
// 2 ln^2 2 W^T (sums of h (u, v)^T (u, v)) W. Without an inverse, needles and giants keep their
// digits.
SP_INLINE void factor_gradient(const Camera& camera, const SplatGradientPack& s, const Vector16& p0,
                               const Vector16& p1, Vector16 dp[2]) {
  const float ln2 = 0.69314718056f;
  const Vector16 a0 = s.ux * p0 + s.uy * p1, a1 = s.vy * p1;
  const F16 scale = F16(4.0f * ln2 * ln2);
  const Vector16 n0 = scale * (s.uu * a0 + s.uv * a1), n1 = scale * (s.uv * a0 + s.vv * a1);
  dp[0] = s.ux * n0;
  dp[1] = s.uy * n0 + s.vy * n1;
  if (!camera.antialiased) return;

  // ln of the compensation is (ln det X - ln det(X + eps)) / 2 with X = P P^T; its derivative by P
  // is (X^-1 - (X + eps)^-1) P = eps X^-1 (X + eps)^-1 P.
  const F16 largest = max(max(largest_component(p0), largest_component(p1)), F16(1e8f));
  const F16 g = F16(1e8f) / largest;
  const Vector16 q0 = g * p0, q1 = g * p1;
  const Vector16 c = cross(q0, q1);
  const F16 factor =
      F16(2.0f * ln2 * camera.eps2d) * s.log_opacity * g * g / max(dot(c, c), F16(1e-37f));
  const Vector16 t0 = s.ux * a0, t1 = s.uy * a0 + s.vy * a1;
  const F16 x01 = dot(q0, q1);
  dp[0] = dp[0] + factor * (dot(q1, q1) * t0 - x01 * t1);
  dp[1] = dp[1] + factor * (dot(q0, q0) * t1 - x01 * t0);
}

// From dL/dm (rows of J R_CW), dL/dmean and dL/ddepth to dL/dp_C; adds to dL/dR_CW's rows.
SP_INLINE Vector16 projection_rows_backward(const Camera& camera, const Vector16& p_C,
                                            const F16& inverse_z, const Vector16 dm[2],
                                            const SplatGradientPack& s, Vector16 dR[3]) {
  const F16 zero = F16(0.0f);
  const Vector16 row[3] = {broadcast(camera.R_CW), broadcast(camera.R_CW + 3),
                           broadcast(camera.R_CW + 6)};
  const float focal[2] = {camera.fx, camera.fy};
  const float low[2] = {camera.min_slope_x, camera.min_slope_y};
  const float high[2] = {camera.max_slope_x, camera.max_slope_y};
  const F16 dmean[2] = {s.mean_x, s.mean_y};
  F16 dxy[2], dz = s.depth;
  for (int i = 0; i < 2; ++i) {
    const F16 free = (i == 0 ? p_C.x : p_C.y) * inverse_z;
    const F16 slope = clamp(free, F16(low[i]), F16(high[i]));
    const F16 scale = F16(focal[i]) * inverse_z;
    const F16 dscale = dot(dm[i], row[i] - slope * row[2]);
    const F16 dslope = zero_unless((free >= F16(low[i])) & (free <= F16(high[i])),
                                   zero - scale * dot(dm[i], row[2]));
    dR[i] = dR[i] + scale * dm[i];
    dR[2] = dR[2] - (scale * slope) * dm[i];
    dxy[i] = inverse_z * dslope + scale * dmean[i];
    dz = dz - (inverse_z * (dscale * scale) + free * dxy[i]);
  }
  return {dxy[0], dxy[1], dz};
}

struct GaussianGradientPack {
  Vector16 mean;
  F16 quat[4], scale[3], opacity;
};

SP_INLINE void add_rows(const GaussianGradientPack& pack, const uint32_t* indices, int lanes,
                        const GaussianGradients& out) {
  alignas(64) float soa[11][kLanes];
  store(soa[0], pack.mean.x);
  store(soa[1], pack.mean.y);
  store(soa[2], pack.mean.z);
  for (int k = 0; k < 4; ++k) store(soa[3 + k], pack.quat[k]);
  for (int k = 0; k < 3; ++k) store(soa[7 + k], pack.scale[k]);
  store(soa[10], pack.opacity);
  for (int lane = 0; lane < lanes; ++lane) {
    const size_t i = indices[lane];
    for (int k = 0; k < 3; ++k) out.means[3 * i + k] += soa[k][lane];
    for (int k = 0; k < 4; ++k) out.quats[4 * i + k] += soa[3 + k][lane];
    for (int k = 0; k < 3; ++k) out.scales[3 * i + k] += soa[7 + k][lane];
    out.opacities[i] += soa[10][lane];
  }
}

// Sums of PoseSums, lane by lane.
struct PoseGradientPack {
  Vector16 R[3], p_C, direction;

  PoseGradientPack() {
    const Vector16 zero = {F16(0.0f), F16(0.0f), F16(0.0f)};
    R[0] = R[1] = R[2] = p_C = direction = zero;
  }

  // From the gradients of p_C and, through colors, of d_W = p_W - center.
  SP_INLINE void add(const Vector16& by_p_C, const Vector16& d_W, const Vector16& by_direction) {
    R[0] = R[0] + by_p_C.x * d_W;
    R[1] = R[1] + by_p_C.y * d_W;
    R[2] = R[2] + by_p_C.z * d_W;
    p_C = p_C + by_p_C;
    direction = direction + by_direction;
  }

  SP_INLINE void write(PoseSums* sums) const {
    const Vector16 vectors[5] = {R[0], R[1], R[2], p_C, direction};
    for (int i = 0; i < 15; ++i) {
      const Vector16& v = vectors[i / 3];
      alignas(64) float lanes[kLanes];
      store(lanes, i % 3 == 0 ? v.x : i % 3 == 1 ? v.y : v.z);
      sums->values[i] = 0.0;
      for (const float lane : lanes) sums->values[i] += static_cast<double>(lane);
    }
  }
};

// Packs 16 splats and their gradients; lanes from `lanes` on repeat the first, without gradient.
SP_INLINE void load_splats(const Splat* splats, const SplatGradient* gradients,
                           const float* means2d, int lanes, bool colors_cut_off, uint32_t* indices,
                           SplatGradientPack& s) {
  alignas(64) float soa[13][kLanes];
  for (int lane = 0; lane < kLanes; ++lane) {
    const int i = lane < lanes ? lane : 0;
    const float keep = lane < lanes ? 1.0f : 0.0f;
    const Splat& splat = splats[i];
    const SplatGradient& g = gradients[i];
    indices[lane] = splat.index;
    soa[0][lane] = splat.ux;
    soa[1][lane] = splat.uy;
    soa[2][lane] = splat.vy;
    soa[3][lane] = keep * means2d[2 * i];
    soa[4][lane] = keep * means2d[2 * i + 1];
    soa[5][lane] = keep * g.log_opacity;
    soa[6][lane] = keep * g.uu;
    soa[7][lane] = keep * g.uv;
    soa[8][lane] = keep * g.vv;
    for (int c = 0; c < 3; ++c) {
      // A color clamped at 0 does not change with its coefficients.
      const bool constant = colors_cut_off && !(splat.color[c] > 0.0f);
      soa[9 + c][lane] = constant ? 0.0f : keep * g.color[c];
    }
    soa[12][lane] = keep * g.depth;
  }
  F16* fields[13] = {&s.ux, &s.uy, &s.vy,   &s.mean_x,   &s.mean_y,   &s.log_opacity, &s.uu,
                     &s.uv, &s.vv, s.color, s.color + 1, s.color + 2, &s.depth};
  for (int f = 0; f < 13; ++f) *fields[f] = load(soa[f]);
}

inline void project_backward(const GaussianArrays& g, const Camera& camera, const Splat* splats,
                             size_t count, const SplatGradient* gradients, const float* means2d,
                             const GaussianGradients& out, PoseSums* pose) {
  PoseGradientPack pose_pack;
  for (size_t first = 0; first < count; first += kLanes) {
    const int lanes = count - first < kLanes ? static_cast<int>(count - first) : kLanes;
    uint32_t indices[kLanes];
    SplatGradientPack s;
    load_splats(splats + first, gradients + first, means2d + 2 * first, lanes, g.sh_degree >= 0,
                indices, s);
    const PackedGaussians in = load_gaussians(g, indices);
    const Vector16 d_W = from_center(camera, in.mean.x, in.mean.y, in.mean.z);
    const Vector16 p_C = to_camera(camera, d_W);
    const F16 inverse_z = F16(1.0f) / p_C.z;
    Vector16 rotation[3], columns[3], m[2];
    rotation_columns(in.quat, rotation);
    for (int k = 0; k < 3; ++k) columns[k] = in.scale[k] * rotation[k];
    projection_rows(camera, p_C, inverse_z, m);
    const Vector16 p0 = {dot(m[0], columns[0]), dot(m[0], columns[1]), dot(m[0], columns[2])};
    const Vector16 p1 = {dot(m[1], columns[0]), dot(m[1], columns[1]), dot(m[1], columns[2])};

    Vector16 dp[2];
    factor_gradient(camera, s, p0, p1, dp);
    const Vector16 dcolumns[3] = {dp[0].x * m[0] + dp[1].x * m[1], dp[0].y * m[0] + dp[1].y * m[1],
                                  dp[0].z * m[0] + dp[1].z * m[1]};
    Vector16 dm[2];
    for (int i = 0; i < 2; ++i) {
      dm[i] = dp[i].x * columns[0] + (dp[i].y * columns[1] + dp[i].z * columns[2]);
    }
    GaussianGradientPack pack;
    for (int k = 0; k < 3; ++k) pack.scale[k] = dot(dcolumns[k], rotation[k]);
    quaternion_gradient(in.quat, in.scale[0] * dcolumns[0], in.scale[1] * dcolumns[1],
                        in.scale[2] * dcolumns[2], pack.quat);
    const Vector16 dp_C = projection_rows_backward(camera, p_C, inverse_z, dm, s, pose_pack.R);
    const Vector16 direction = colors_backward(g, indices, lanes, d_W, s.color, out.colors);
    pose_pack.add(dp_C, d_W, direction);
    pack.mean = to_world(camera, dp_C) + direction;
    pack.opacity = s.log_opacity / in.opacity;
    add_rows(pack, indices, lanes, out);
  }
  pose_pack.write(pose);
}

}  // namespace splatpilot::SIMD_LEVEL
