// Projection of baked scenes: boxes of neighbouring Gaussians are culled together, and what is left
// is read straight as packs.
#pragma once

#include "projection.hpp"

namespace splatpilot::SIMD_LEVEL {

// Whether boxes of Gaussians may touch the image, for the 16 boxes of one bound group.
SP_INLINE uint32_t visible_boxes(const BakedArrays& scene, const Camera& camera, size_t group) {
  const float* bounds = scene.bounds + group * 7 * kLanes;
  const Vector16 p_C = to_camera(
      camera, from_centre(camera, load(bounds), load(bounds + kLanes), load(bounds + 2 * kLanes)));
  const F16 half[3] = {load(bounds + 3 * kLanes), load(bounds + 4 * kLanes),
                       load(bounds + 5 * kLanes)};
  const F16 largest_scale = load(bounds + 6 * kLanes);
  const float* R = camera.R_CW;
  // How far the box reaches along a direction n given in the camera frame.
  const auto reach_along = [&](const float n[3]) {
    F16 sum = F16(0.0f);
    for (int axis = 0; axis < 3; ++axis) {
      sum += F16(__builtin_fabsf(n[0] * R[axis] + n[1] * R[3 + axis] + n[2] * R[6 + axis])) *
             half[axis];
    }
    return sum;
  };
  const float forward[3] = {0.0f, 0.0f, 1.0f};
  const F16 depth_reach = reach_along(forward);
  Mask16 visible = (p_C.z + depth_reach >= F16(camera.near_plane)) &
                   (p_C.z - depth_reach <= F16(camera.far_plane));
  for (int side = 0; side < 4; ++side) {
    const F16 reach =
        reach_along(camera.side_normal[side]) + F16(camera.side_reach[side]) * largest_scale;
    visible = visible & (dot(camera.side_normal[side], p_C) + reach > F16(0.0f));
  }
  return lane_bits(visible);
}

// The inverse of the lower-triangular L times a.
SP_INLINE Vector16 whitened(const F16 L[6], const Vector16& a) {
  const F16 x = a.x / L[0], y = (a.y - L[1] * x) / L[2];
  return {x, y, (a.z - L[3] * x - L[4] * y) / L[5]};
}

SP_INLINE size_t project_baked_group(const BakedArrays& scene, const Camera& camera, size_t group,
                                     Splat* splats, DepthPlane* planes, uint32_t* depth_bits) {
  const float* geometry = scene.geometry + group * 10 * kLanes;
  const auto field = [&](int f) { return load(geometry + f * kLanes); };
  const Vector16 d_W = from_centre(camera, field(0), field(1), field(2));
  const Vector16 p_C = to_camera(camera, d_W);
  if (!any(in_depth_range(camera, p_C.z))) return 0;
  const F16 inverse_z = F16(1.0f) / p_C.z;
  Vector16 m[2];
  projection_rows(camera, p_C, inverse_z, m);
  F16 L[6];
  for (int k = 0; k < 6; ++k) L[k] = field(3 + k);
  const auto times_L = [&](const Vector16& row) -> Vector16 {
    return {row.x * L[0] + row.y * L[1] + row.z * L[3], row.y * L[2] + row.z * L[4], row.z * L[5]};
  };
  const Vector16 p0 = times_L(m[0]), p1 = times_L(m[1]);
  SplatPack pack;
  PlanePack plane;
  if (planes) {
    plane = depth_plane(camera, p_C.z, inverse_z, whitened(L, camera_axis(camera, 0)),
                        whitened(L, camera_axis(camera, 1)), whitened(L, d_W));
    plane.seen = reaches_image(camera, p_C, times_L);
  }
  uint32_t bits = lane_bits(
      finish_projection(camera, p_C, inverse_z, p0, p1, field(9), planes ? &plane : nullptr, pack));
  if (!bits) return 0;
  if (planes) append_planes(plane, bits, planes);

  F16 color[3];
  const int coefficients = (scene.sh_degree + 1) * (scene.sh_degree + 1);
  const float* colors = scene.colors + group * (3 * coefficients) * kLanes;
  if (scene.sh_degree == 0) {
    for (int c = 0; c < 3; ++c) color[c] = load(colors + c * kLanes);
  } else {
    evaluate_sh(scene.sh_degree, colors, d_W.x, d_W.y, d_W.z, color);
  }
  uint32_t indices[kLanes];
  for (int i = 0; i < kLanes; ++i) indices[i] = static_cast<uint32_t>(group * kLanes + i);
  return append_splats(pack, color, bits, indices, splats, depth_bits);
}

// begin and end count Gaussians and are multiples of the chunk size, or the scene's end.
inline size_t project_baked(const BakedArrays& scene, const Camera& camera, size_t begin,
                            size_t end, Splat* splats, DepthPlane* planes, uint32_t* depth_bits) {
  constexpr size_t kGroupsPerBox = kBoundSize / kLanes;
  const size_t last_group = end / kLanes;
  size_t count = 0;
  for (size_t box = begin / kBoundSize; box * kGroupsPerBox < last_group; box += kLanes) {
    uint32_t boxes = visible_boxes(scene, camera, box / kLanes);
    for (; boxes; boxes &= boxes - 1) {
      const size_t first = (box + __builtin_ctz(boxes)) * kGroupsPerBox;
      for (size_t group = first; group < first + kGroupsPerBox && group < last_group; ++group) {
        count += project_baked_group(scene, camera, group, splats + count,
                                     planes ? planes + count : nullptr, depth_bits + count);
      }
    }
  }
  return count;
}

}  // namespace splatpilot::SIMD_LEVEL
