// Projection of input arrays and of baked scenes. Arrays are culled by position and largest scale,
// and the candidates packed; of baked scenes, boxes of neighbors are culled together.
#pragma once

#include "project/projection.hpp"
#include "project/spherical_harmonics.hpp"

namespace splatpilot::SIMD_LEVEL {

// Finds the Gaussians among [begin, end) that may touch the image by position and the largest of
// their first `kAxes` scales; returns their number. One of scale s reaches `side_reach` s across
// the sides of the image. `candidates` is padded with `begin` to whole packs.
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
struct PackedGaussians {
  Vector16 mean;
  F16 quat[4], scale[3], opacity;
};

SP_INLINE PackedGaussians load_gaussians(const GaussianArrays& g, const uint32_t* indices) {
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

// Prefetches the first `used` floats of rows.
SP_INLINE void prefetch_rows(const float* rows, int stride, int used, const uint32_t* indices,
                             uint32_t bits) {
  constexpr int kFloatsPerLine = 16;
  if (used <= kFloatsPerLine) return;
  for (; bits; bits &= bits - 1) {
    const float* row = rows + static_cast<size_t>(stride) * indices[__builtin_ctz(bits)];
    for (int k = 0; k < used; k += kFloatsPerLine) __builtin_prefetch(row + k);
  }
}

// Evaluates the colors of the lanes in `bits`.
SP_INLINE void load_colors(const GaussianArrays& g, const uint32_t* indices, uint32_t bits,
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

// Projects a pack of Gaussians with covariances F F^T, those in `lanes`; returns the number of
// visible ones. times_factor(row) is F^T row, normal() the inverse covariance times d_W, up to
// scale, in the camera frame, and colors(lanes, color) writes colors.
template <bool kDistorted, typename Factor, typename Normal, typename Colors>
SP_INLINE size_t project_pack(const Camera& camera, const Vector16& d_W, const F16& log2_opacity,
                              uint32_t lanes, const uint32_t* indices, const Factor& times_factor,
                              const Normal& normal, const Colors& colors, Splat* splats,
                              DepthPlane* planes, uint32_t* depth_bits) {
  const Vector16 p_C = to_camera(camera, d_W);
  if (!any(in_depth_range(camera, p_C.z))) return 0;
  const F16 inverse_z = F16(1.0f) / p_C.z;
  Vector16 m[2];
  projection_rows<kDistorted>(camera, p_C, inverse_z, m);
  const Vector16 p0 = times_factor(m[0]), p1 = times_factor(m[1]);
  SplatPack pack;
  Mask16 visible =
      finish_projection<kDistorted>(camera, p_C, inverse_z, p0, p1, log2_opacity, pack);
  Mask16 shown = visible;
  if (planes) {
    const F16 sigma_z = norm(times_factor(broadcast(camera.R_CW + 6)));
    shown = within_max_depth(camera, p_C.z, sigma_z);
    if (camera.depth_alone) visible = visible & shown;
  }
  const uint32_t bits = lane_bits(visible) & lanes;
  if (!bits) return 0;
  if (planes) {
    PlanePack plane = depth_plane<kDistorted>(camera, p_C, inverse_z, p0, p1, normal());
    hide_unless(shown, plane);
    append_planes(plane, bits, planes);
  }
  F16 color[3];
  for (int c = 0; c < 3; ++c) color[c] = F16(0.0f);
  if (!camera.depth_alone) colors(bits, color);
  return append_splats(pack, color, bits, indices, splats, depth_bits);
}

// Culls Gaussians [begin, end) and calls project(gaussians, indices, lanes, count), which returns
// the number of visible ones, for packs of the others; `count` is their sum so far.
template <int kAxes, typename Project>
SP_INLINE size_t project_candidates(const GaussianArrays& g, const Camera& camera,
                                    const float* side_reach, size_t begin, size_t end,
                                    const Project& project) {
  uint32_t candidates[kChunkSize + kLanes];
  const size_t candidate_count = cull<kAxes>(g, camera, side_reach, begin, end, candidates);
  size_t count = 0;
  for (size_t first = 0; first < candidate_count; first += kLanes) {
    const size_t rest = candidate_count - first;
    const uint32_t lanes = rest < kLanes ? (1u << rest) - 1 : 0xffff;
    const uint32_t* indices = candidates + first;
    count += project(load_gaussians(g, indices), indices, lanes, count);
  }
  return count;
}

// log2 of opacities; zero has none, and any value below the cut serves.
SP_INLINE F16 log2_opacity(const PackedGaussians& in) { return log2(max(in.opacity, F16(1e-30f))); }

template <bool kDistorted>
size_t project_arrays_through(const GaussianArrays& g, const Camera& camera, size_t begin,
                              size_t end, Splat* splats, DepthPlane* planes, uint32_t* depth_bits) {
  const auto project = [&](const PackedGaussians& in, const uint32_t* indices, uint32_t lanes,
                           size_t count) {
    const Vector16 d_W = from_center(camera, in.mean.x, in.mean.y, in.mean.z);
    Vector16 axes[3], columns[3];
    rotation_columns(in.quat, axes);
    for (int k = 0; k < 3; ++k) columns[k] = in.scale[k] * axes[k];
    const auto times_factor = [&](const Vector16& row) -> Vector16 {
      return {dot(row, columns[0]), dot(row, columns[1]), dot(row, columns[2])};
    };
    const auto normal = [&]() {
      const F16 min_scale = min(min(in.scale[0], in.scale[1]), in.scale[2]);
      Vector16 n_W = {F16(0.0f), F16(0.0f), F16(0.0f)};
      for (int k = 0; k < 3; ++k) {
        const F16 ratio = min_scale / in.scale[k];
        n_W = n_W + (ratio * ratio * dot(axes[k], d_W)) * axes[k];
      }
      return to_camera(camera, n_W);
    };
    const auto colors = [&](uint32_t bits, F16 color[3]) {
      load_colors(g, indices, bits, d_W, color);
    };
    return project_pack<kDistorted>(camera, d_W, log2_opacity(in), lanes, indices, times_factor,
                                    normal, colors, splats + count,
                                    planes ? planes + count : nullptr, depth_bits + count);
  };
  return project_candidates<3>(g, camera, camera.side_reach, begin, end, project);
}

inline size_t project_arrays(const GaussianArrays& g, const Camera& camera, size_t begin,
                             size_t end, Splat* splats, DepthPlane* planes, uint32_t* depth_bits) {
  const bool distorted = camera.distortion.model != DistortionModel::kNone;
  const auto project = distorted ? project_arrays_through<true> : project_arrays_through<false>;
  return project(g, camera, begin, end, splats, planes, depth_bits);
}

// Boxes of the 16 of one bound group, one bit each.
struct Boxes {
  uint32_t visible;               // may touch the image
  uint32_t merged[kMergeLevels];  // may be drawn merged
};

SP_INLINE Boxes find_boxes(const BakedArrays& scene, const Camera& camera, size_t group) {
  const float* bounds = scene.bounds + group * 7 * kLanes;
  const Vector16 p_C = to_camera(
      camera, from_center(camera, load(bounds), load(bounds + kLanes), load(bounds + 2 * kLanes)));
  const F16 half[3] = {load(bounds + 3 * kLanes), load(bounds + 4 * kLanes),
                       load(bounds + 5 * kLanes)};
  const F16 largest_scale = load(bounds + 6 * kLanes);
  const float* R = camera.R_CW;
  // Half the extent of the box along a direction n in the camera frame.
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
    const F16 min_depth = max(p_C.z - depth_reach, F16(0.0f));
    visible = visible & within_max_depth(camera, min_depth, largest_scale, 1.0001f);
  }
  for (int side = 0; side < 4; ++side) {
    const F16 reach =
        reach_along(camera.side_normal[side]) + F16(camera.side_reach[side]) * largest_scale;
    visible = visible & (dot(camera.side_normal[side], p_C) + reach > F16(0.0f));
  }
  Boxes boxes{lane_bits(visible), {}};
  if (camera.merged_spread > 0.0f) {
    const F16 limit = F16(camera.merged_spread / max(camera.fx, camera.fy)) * (p_C.z - depth_reach);
    for (int level = 0; level < kMergeLevels; ++level) {
      const F16 spread = load(scene.spreads + (group * kMergeLevels + level) * kLanes);
      boxes.merged[level] = lane_bits(spread <= limit);
    }
  }
  return boxes;
}

// `geometry` and `colors` are those of a group whose first Gaussian has the number `first`.
template <bool kDistorted>
SP_INLINE size_t project_baked_group(const BakedArrays& scene, const Camera& camera,
                                     const float* geometry, const float* colors, size_t first,
                                     Splat* splats, DepthPlane* planes, uint32_t* depth_bits) {
  const auto field = [&](int f) { return load(geometry + f * kLanes); };
  const Vector16 d_W = from_center(camera, field(0), field(1), field(2));
  F16 L[6];
  for (int k = 0; k < 6; ++k) L[k] = field(3 + k);
  const auto times_L = [&](const Vector16& row) -> Vector16 {
    return {row.x * L[0] + row.y * L[1] + row.z * L[3], row.y * L[2] + row.z * L[4], row.z * L[5]};
  };
  // Times (L00 L11 L22)^2, which takes no division.
  const auto normal = [&]() {
    const F16 L11_L22 = L[2] * L[5];
    const F16 y0 = d_W.x * L11_L22;
    const F16 rest = d_W.y * L[0] - L[1] * d_W.x;
    const F16 y1 = rest * L[5];
    const F16 y2 = (d_W.z * L[0] - L[3] * d_W.x) * L[2] - L[4] * rest;
    const F16 n2 = L[0] * L[2] * y2;
    const F16 n1 = L[0] * (L[5] * y1 - L[4] * y2);
    const F16 n0 = L11_L22 * y0 - L[1] * (L[5] * y1 - L[4] * y2) - L[2] * L[3] * y2;
    return to_camera(camera, Vector16{n0, n1, n2});
  };
  const auto write_colors = [&](uint32_t, F16 color[3]) {
    if (scene.sh_degree == 0) {
      for (int c = 0; c < 3; ++c) color[c] = load(colors + c * kLanes);
    } else {
      evaluate_sh(scene.sh_degree, colors, d_W.x, d_W.y, d_W.z, color);
    }
  };
  uint32_t indices[kLanes];
  for (int i = 0; i < kLanes; ++i) indices[i] = static_cast<uint32_t>(first + i);
  return project_pack<kDistorted>(camera, d_W, field(9), 0xffff, indices, times_L, normal,
                                  write_colors, splats, planes, depth_bits);
}

template <bool kDistorted>
size_t project_baked_through(const BakedArrays& scene, const Camera& camera, size_t begin,
                             size_t end, Splat* splats, DepthPlane* planes, uint32_t* depth_bits) {
  constexpr size_t kGroupsPerBox = kBoundSize / kLanes;
  const size_t last_group = end / kLanes;
  const size_t values = 3 * static_cast<size_t>((scene.sh_degree + 1) * (scene.sh_degree + 1));
  size_t count = 0;
  const auto project = [&](const float* geometry, const float* colors, size_t group, size_t first) {
    count += project_baked_group<kDistorted>(
        scene, camera, geometry + group * 10 * kLanes, colors + group * values * kLanes, first,
        splats + count, planes ? planes + count : nullptr, depth_bits + count);
  };
  for (size_t begin_box = begin / kBoundSize; begin_box * kGroupsPerBox < last_group;
       begin_box += kLanes) {
    const Boxes boxes = find_boxes(scene, camera, begin_box / kLanes);
    for (uint32_t bits = boxes.visible; bits; bits &= bits - 1) {
      const int lane = __builtin_ctz(bits);
      const size_t box = begin_box + lane, first = box * kGroupsPerBox;
      int level = kMergeLevels;
      while (level > 0 && !(boxes.merged[level - 1] >> lane & 1)) --level;
      if (level > 0) {
        project(scene.merged_geometry, scene.merged_colors, box * kMergeLevels + level - 1,
                first * kLanes);
        continue;
      }
      for (size_t group = first; group < first + kGroupsPerBox && group < last_group; ++group) {
        project(scene.geometry, scene.colors, group, group * kLanes);
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
