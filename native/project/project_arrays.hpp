// Projection of input tensors: a first pass culls by position and largest scale, a second gathers
// the candidates into packs and projects them.
#pragma once

#include "raster/depth_planes.hpp"

namespace splatpilot::SIMD_LEVEL {

// Finds the Gaussians among [begin, end) that may touch the image by position and the largest of
// their first `kAxes` scales, and returns their number. One of scale s reaches `side_reach` s
// across the sides of the image. `candidates` is padded with `begin` to whole packs.
template <int kAxes>
SP_INLINE size_t cull(const GaussianArrays& g, const Camera& camera, const float* side_reach,
                      size_t begin, size_t end, uint32_t* candidates) {
  size_t count = 0;
  for (size_t first = begin; first < end; first += kLanes) {
    const size_t lanes = end - first < kLanes ? end - first : kLanes;
    alignas(64) float soa[3 + kAxes][kLanes] = {};
    for (size_t lane = 0; lane < lanes; ++lane) {
      const float* mean = g.means + 3 * (first + lane);
      const float* scale = g.scales + 3 * (first + lane);
      for (int axis = 0; axis < 3; ++axis) soa[axis][lane] = mean[axis];
      for (int axis = 0; axis < kAxes; ++axis) soa[3 + axis][lane] = scale[axis];
    }
    const Vector16 p_C =
        to_camera(camera, from_center(camera, load(soa[0]), load(soa[1]), load(soa[2])));
    F16 largest_scale = load(soa[3]);
    for (int axis = 1; axis < kAxes; ++axis) {
      largest_scale = max(largest_scale, load(soa[3 + axis]));
    }
    Mask16 visible = in_depth_range(camera, p_C.z);
    for (int side = 0; side < 4; ++side) {
      const F16 reach = F16(side_reach[side]) * largest_scale;
      visible = visible & (dot(camera.side_normal[side], p_C) + reach > F16(0.0f));
    }
    for (uint32_t bits = lane_bits(visible) & ((1u << lanes) - 1); bits; bits &= bits - 1) {
      candidates[count++] = static_cast<uint32_t>(first) + __builtin_ctz(bits);
    }
  }
  for (int i = 0; i < kLanes; ++i) candidates[count + i] = static_cast<uint32_t>(begin);
  return count;
}

// Sixteen Gaussians of the input.
struct GatheredGaussians {
  Vector16 mean;
  F16 quat[4], scale[3], opacity;
};

SP_INLINE GatheredGaussians gather_gaussians(const GaussianArrays& g, const uint32_t* indices) {
  alignas(64) float soa[11][kLanes];
  for (int lane = 0; lane < kLanes; ++lane) {
    const size_t i = indices[lane];
    for (int axis = 0; axis < 3; ++axis) soa[axis][lane] = g.means[3 * i + axis];
    for (int k = 0; k < 4; ++k) soa[3 + k][lane] = g.quats[4 * i + k];
    for (int axis = 0; axis < 3; ++axis) soa[7 + axis][lane] = g.scales[3 * i + axis];
    soa[10][lane] = g.opacities[i];
  }
  return {{load(soa[0]), load(soa[1]), load(soa[2])},
          {load(soa[3]), load(soa[4]), load(soa[5]), load(soa[6])},
          {load(soa[7]), load(soa[8]), load(soa[9])},
          load(soa[10])};
}

// The columns of R(q) diag(scale), a factor of the covariance, for quaternions of any length.
SP_INLINE void covariance_factor(const F16 q[4], const F16 scale[3], Vector16 columns[3]) {
  const F16 two = F16(2.0f) / (q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]);
  const F16 w = q[0], x = q[1], y = q[2], z = q[3], one = F16(1.0f);
  columns[0] = {scale[0] * (one - two * (y * y + z * z)), scale[0] * (two * (x * y + w * z)),
                scale[0] * (two * (x * z - w * y))};
  columns[1] = {scale[1] * (two * (x * y - w * z)), scale[1] * (one - two * (x * x + z * z)),
                scale[1] * (two * (y * z + w * x))};
  columns[2] = {scale[2] * (two * (x * z + w * y)), scale[2] * (two * (y * z - w * x)),
                scale[2] * (one - two * (x * x + y * y))};
}

SP_INLINE F16 dot(const Vector16& a, const Vector16& b) {
  return a.x * b.x + a.y * b.y + a.z * b.z;
}

// Asks for the first `used` floats of rows that are read soon, all at once.
SP_INLINE void prefetch_rows(const float* rows, int stride, int used, const uint32_t* indices,
                             uint32_t bits) {
  constexpr int kFloatsPerLine = 16;
  if (used <= kFloatsPerLine) return;
  for (; bits; bits &= bits - 1) {
    const float* row = rows + static_cast<size_t>(stride) * indices[__builtin_ctz(bits)];
    for (int k = 0; k < used; k += kFloatsPerLine) __builtin_prefetch(row + k);
  }
}

// Gathers the colors of the lanes in `bits` and evaluates them.
SP_INLINE void gather_colors(const GaussianArrays& g, const uint32_t* indices, uint32_t bits,
                             const Vector16& d_W, F16 color[3]) {
  const int used = g.sh_degree < 0 ? 1 : (g.sh_degree + 1) * (g.sh_degree + 1);
  const int stored = g.sh_degree < 0 ? 1 : g.sh_coefficients;
  alignas(64) float soa[3 * 16][kLanes];
  for (int k = 0; k < 3 * used; ++k) store(soa[k], F16(0.0f));
  prefetch_rows(g.colors, 3 * stored, 3 * used, indices, bits);
  for (; bits; bits &= bits - 1) {
    const int lane = __builtin_ctz(bits);
    const float* row = g.colors + static_cast<size_t>(3 * stored) * indices[lane];
    for (int k = 0; k < 3 * used; ++k) soa[k][lane] = row[k];
  }
  if (g.sh_degree < 0) {
    for (int c = 0; c < 3; ++c) color[c] = load(soa[c]);
  } else {
    evaluate_sh(g.sh_degree, soa[0], d_W.x, d_W.y, d_W.z, color);
  }
}

// In the camera frame: the inverse covariance times p_C, up to scale, from the columns of its
// factor.
SP_INLINE Vector16 plane_normal(const Camera& camera, const Vector16 columns[3], const F16 scale[3],
                                const Vector16& d_W) {
  const F16 least = min(min(scale[0], scale[1]), scale[2]);
  Vector16 n_W = {F16(0.0f), F16(0.0f), F16(0.0f)};
  for (int k = 0; k < 3; ++k) {
    const F16 ratio = least / scale[k];
    const Vector16 axis = (F16(1.0f) / scale[k]) * columns[k];
    n_W = n_W + (ratio * ratio * dot(axis, d_W)) * axis;
  }
  return to_camera(camera, n_W);
}

template <bool kDistorted>
size_t project_arrays_through(const GaussianArrays& g, const Camera& camera, size_t begin,
                              size_t end, Splat* splats, DepthPlane* planes, uint32_t* depth_bits) {
  uint32_t candidates[kChunkSize + kLanes];
  const size_t candidate_count = cull<3>(g, camera, camera.side_reach, begin, end, candidates);
  size_t count = 0;
  for (size_t first = 0; first < candidate_count; first += kLanes) {
    const uint32_t* indices = candidates + first;
    const GatheredGaussians in = gather_gaussians(g, indices);
    const Vector16 d_W = from_center(camera, in.mean.x, in.mean.y, in.mean.z);
    const Vector16 p_C = to_camera(camera, d_W);
    const F16 inverse_z = F16(1.0f) / p_C.z;
    Vector16 columns[3], m[2];
    covariance_factor(in.quat, in.scale, columns);
    projection_rows<kDistorted>(camera, p_C, inverse_z, m);
    const Vector16 p0 = {dot(m[0], columns[0]), dot(m[0], columns[1]), dot(m[0], columns[2])};
    const Vector16 p1 = {dot(m[1], columns[0]), dot(m[1], columns[1]), dot(m[1], columns[2])};
    // An opacity of zero has no logarithm; any value below the cut serves.
    const F16 log2_opacity = log2(max(in.opacity, F16(1e-30f)));

    SplatPack pack;
    uint32_t bits = lane_bits(
        finish_projection<kDistorted>(camera, p_C, inverse_z, p0, p1, log2_opacity, pack));
    if (candidate_count - first < kLanes) bits &= (1u << (candidate_count - first)) - 1;
    if (!bits) continue;
    if (planes) {
      const Vector16 n_C = plane_normal(camera, columns, in.scale, d_W);
      PlanePack plane = depth_plane<kDistorted>(camera, p_C, inverse_z, p0, p1, n_C);
      const float* forward = camera.R_CW + 6;
      const F16 sigma_z =
          norm({dot(forward, columns[0]), dot(forward, columns[1]), dot(forward, columns[2])});
      hide_unless(within_max_depth(camera, p_C.z, sigma_z), plane);
      append_planes(plane, bits, planes + count);
    }
    F16 color[3];
    gather_colors(g, indices, bits, d_W, color);
    count += append_splats(pack, color, bits, indices, splats + count, depth_bits + count);
  }
  return count;
}

inline size_t project_arrays(const GaussianArrays& g, const Camera& camera, size_t begin,
                             size_t end, Splat* splats, DepthPlane* planes, uint32_t* depth_bits) {
  const bool distorted = camera.distortion.model != DistortionModel::kNone;
  const auto project = distorted ? project_arrays_through<true> : project_arrays_through<false>;
  return project(g, camera, begin, end, splats, planes, depth_bits);
}

}  // namespace splatpilot::SIMD_LEVEL
