// Projection of baked scenes: boxes of neighboring Gaussians are culled together, and what is left
// is read straight as packs.
#pragma once

#include "raster/depth_planes.hpp"

namespace splatpilot::SIMD_LEVEL {

// Whether boxes of Gaussians may touch the image, for the 16 boxes of one bound group.
SP_INLINE uint32_t visible_boxes(const BakedArrays& scene, const Camera& camera, size_t group) {
  const float* bounds = scene.bounds + group * 7 * kLanes;
  const Vector16 p_C = to_camera(
      camera, from_center(camera, load(bounds), load(bounds + kLanes), load(bounds + 2 * kLanes)));
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
  if (camera.depth_alone) {
    const F16 nearest = max(p_C.z - depth_reach, F16(0.0f));
    visible = visible & within_max_depth(camera, nearest, largest_scale, 1.0001f);
  }
  for (int side = 0; side < 4; ++side) {
    const F16 reach =
        reach_along(camera.side_normal[side]) + F16(camera.side_reach[side]) * largest_scale;
    visible = visible & (dot(camera.side_normal[side], p_C) + reach > F16(0.0f));
  }
  return lane_bits(visible);
}

// In the camera frame: the inverse of L L^T times d_W, up to scale: multiplied by (L00 L11 L22)^2,
// which takes no division.
SP_INLINE Vector16 plane_normal(const Camera& camera, const F16 L[6], const Vector16& d_W) {
  const F16 L11_L22 = L[2] * L[5];
  const F16 y0 = d_W.x * L11_L22;
  const F16 rest = d_W.y * L[0] - L[1] * d_W.x;
  const F16 y1 = rest * L[5];
  const F16 y2 = (d_W.z * L[0] - L[3] * d_W.x) * L[2] - L[4] * rest;
  const F16 n2 = L[0] * L[2] * y2;
  const F16 n1 = L[0] * (L[5] * y1 - L[4] * y2);
  const F16 n0 = L11_L22 * y0 - L[1] * (L[5] * y1 - L[4] * y2) - L[2] * L[3] * y2;
  return to_camera(camera, {n0, n1, n2});
}

template <bool kDistorted>
SP_INLINE size_t project_baked_group(const BakedArrays& scene, const Camera& camera, size_t group,
                                     Splat* splats, DepthPlane* planes, uint32_t* depth_bits) {
  const float* geometry = scene.geometry + group * 10 * kLanes;
  const auto field = [&](int f) { return load(geometry + f * kLanes); };
  const Vector16 d_W = from_center(camera, field(0), field(1), field(2));
  const Vector16 p_C = to_camera(camera, d_W);
  if (!any(in_depth_range(camera, p_C.z))) return 0;
  const F16 inverse_z = F16(1.0f) / p_C.z;
  Vector16 m[2];
  projection_rows<kDistorted>(camera, p_C, inverse_z, m);
  F16 L[6];
  for (int k = 0; k < 6; ++k) L[k] = field(3 + k);
  const auto times_L = [&](const Vector16& row) -> Vector16 {
    return {row.x * L[0] + row.y * L[1] + row.z * L[3], row.y * L[2] + row.z * L[4], row.z * L[5]};
  };
  const Vector16 p0 = times_L(m[0]), p1 = times_L(m[1]);
  const float* R = camera.R_CW;
  const F16 sigma_z = norm(times_L({F16(R[6]), F16(R[7]), F16(R[8])}));
  const Mask16 shown = within_max_depth(camera, p_C.z, sigma_z);
  SplatPack pack;
  Mask16 visible = finish_projection<kDistorted>(camera, p_C, inverse_z, p0, p1, field(9), pack);
  if (camera.depth_alone) visible = visible & shown;
  const uint32_t bits = lane_bits(visible);
  if (!bits) return 0;
  if (planes) {
    const Vector16 n_C = plane_normal(camera, L, d_W);
    PlanePack plane = depth_plane<kDistorted>(camera, p_C, inverse_z, p0, p1, n_C);
    hide_unless(shown, plane);
    append_planes(plane, bits, planes);
  }

  F16 color[3];
  const int coefficients = (scene.sh_degree + 1) * (scene.sh_degree + 1);
  const float* colors = scene.colors + group * (3 * coefficients) * kLanes;
  if (camera.depth_alone) {
    for (int c = 0; c < 3; ++c) color[c] = F16(0.0f);
  } else if (scene.sh_degree == 0) {
    for (int c = 0; c < 3; ++c) color[c] = load(colors + c * kLanes);
  } else {
    evaluate_sh(scene.sh_degree, colors, d_W.x, d_W.y, d_W.z, color);
  }
  uint32_t indices[kLanes];
  for (int i = 0; i < kLanes; ++i) indices[i] = static_cast<uint32_t>(group * kLanes + i);
  return append_splats(pack, color, bits, indices, splats, depth_bits);
}

// begin and end count Gaussians and are multiples of the chunk size, or the scene's end.
template <bool kDistorted>
size_t project_baked_through(const BakedArrays& scene, const Camera& camera, size_t begin,
                             size_t end, Splat* splats, DepthPlane* planes, uint32_t* depth_bits) {
  constexpr size_t kGroupsPerBox = kBoundSize / kLanes;
  const size_t last_group = end / kLanes;
  size_t count = 0;
  for (size_t box = begin / kBoundSize; box * kGroupsPerBox < last_group; box += kLanes) {
    uint32_t boxes = visible_boxes(scene, camera, box / kLanes);
    for (; boxes; boxes &= boxes - 1) {
      const size_t first = (box + __builtin_ctz(boxes)) * kGroupsPerBox;
      for (size_t group = first; group < first + kGroupsPerBox && group < last_group; ++group) {
        count +=
            project_baked_group<kDistorted>(scene, camera, group, splats + count,
                                            planes ? planes + count : nullptr, depth_bits + count);
      }
    }
  }
  return count;
}

inline size_t project_baked(const BakedArrays& scene, const Camera& camera, size_t begin,
                            size_t end, Splat* splats, DepthPlane* planes, uint32_t* depth_bits) {
  const bool distorted = camera.distortion.model != DistortionModel::kNone;
  const auto project = distorted ? project_baked_through<true> : project_baked_through<false>;
  return project(scene, camera, begin, end, splats, planes, depth_bits);
}

}  // namespace splatpilot::SIMD_LEVEL
