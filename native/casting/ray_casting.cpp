// The casting kernels of one SIMD level, without fused products and sums: all levels give bitwise
// identical depths.
#include "casting/ray_casting.hpp"

#include "core/simd.hpp"
#include "core/vectors.hpp"
#include "fields/grid_interpolation.hpp"
#include "fields/shape_distances.hpp"

namespace splatpilot::SIMD_LEVEL {

constexpr float kInfinity = __builtin_inff();
constexpr float kGraze = 1e-4f;     // [m], a shorter path through a shape is a miss
constexpr float kParallel = 1e-9f;  // keeps cosines that are divided by from 0

// The depth image of a camera so far.
struct Image {
  const float *x, *y, *z;  // rays in W, of depth 1
  const float* square;     // of their lengths
  float* depth;
  size_t size;  // whole packs
  float half_pixel;
  const float* p;      // the camera
  const float* ahead;  // its z axis in W
  float min_depth;     // of the current shape
};

// Half the width of a pixel at the point `away` from the camera [m].
SP_INLINE float footprint(const Image& image, const float* away) {
  const float planar = maximum(dot(away, image.ahead), 0.0f);
  return image.half_pixel * planar * planar / maximum(length(away), 1e-3f);
}

SP_INLINE bool may_be_seen(const Image& image, size_t i) {
  return any(load(image.depth + i) > F16(image.min_depth));
}

SP_INLINE F16 dot_rays(const Image& image, size_t i, const float* a) {
  return F16(a[0]) * load(image.x + i) + F16(a[1]) * load(image.y + i) +
         F16(a[2]) * load(image.z + i);
}

// Rays that enter a shape widened by `extra` before they leave it hit it.
SP_INLINE void see(const Image& image, size_t i, const F16& enter, const F16& leave, float extra) {
  const F16 begin = max(enter, F16(0.0f));
  const F16 depth = select(leave - begin >= F16(kGraze), begin + F16(extra), F16(kInfinity));
  store(image.depth + i, min(depth, load(image.depth + i)));
}

SP_INLINE size_t whole_packs(size_t count) { return (count + kLanes - 1) / kLanes * kLanes; }

static size_t casting_scratch(size_t rays, size_t bodies) {
  return 5 * whole_packs(rays) + 2 * bodies;
}

// An image at infinite depth.
SP_INLINE Image begin_image(const PixelRays& rays, const CameraPose& pose, float* scratch,
                            float* ahead) {
  const size_t size = whole_packs(rays.count);
  float* in_W[5];
  for (int k = 0; k < 5; ++k) in_W[k] = scratch + k * size;
  for (size_t i = 0; i < size; i += kLanes) {
    F16 square = F16(0.0f);
    for (int k = 0; k < 3; ++k) {
      const F16 d = F16(pose.R[3 * k]) * load(rays.x + i) +
                    F16(pose.R[3 * k + 1]) * load(rays.y + i) + F16(pose.R[3 * k + 2]);
      store(in_W[k] + i, d);
      square += d * d;
    }
    store(in_W[3] + i, square);
    store(in_W[4] + i, F16(kInfinity));
  }
  for (int k = 0; k < 3; ++k) ahead[k] = pose.R[3 * k + 2];
  return {in_W[0], in_W[1],         in_W[2], in_W[3], in_W[4],
          size,    rays.half_pixel, pose.p,  ahead,   -kInfinity};
}

SP_INLINE void write_image(const Image& image, const PixelRays& rays, float* depth) {
  for (size_t i = 0; i < rays.count; ++i) depth[rays.pixels[i]] = image.depth[i];
}

// Shapes.

constexpr float kSlack = 1e-3f;  // [m], for rounding
// Widening by e moves surfaces by at most this times e, at corners of boxes.
constexpr float kCorner = 1.7320509f;

// A sphere widened by half a pixel, from the camera.
struct Sphere {
  float m[3], c, extra;  // c: the square of the distance beyond its surface, about
};

SP_INLINE Sphere make_sphere(const Image& image, const float* center, float radius) {
  Sphere sphere;
  float away[3];
  subtract(image.p, center, sphere.m);
  subtract(center, image.p, away);
  sphere.extra = footprint(image, away);
  const float wide = radius + sphere.extra;
  sphere.c = dot(sphere.m, sphere.m) - wide * wide;
  return sphere;
}

SP_INLINE void see_sphere(const Image& image, size_t i, const Sphere& sphere) {
  const F16 a = load(image.square + i), b = dot_rays(image, i, sphere.m);
  const F16 discriminant = b * b - a * F16(sphere.c);
  if (!any(discriminant > F16(0.0f))) return;
  const F16 root = sqrt(max(discriminant, F16(0.0f))), per_a = F16(1.0f) / a;
  see(image, i, (-b - root) * per_a, (root - b) * per_a, sphere.extra);
}

// A cylinder widened by half a pixel, from the camera.
struct Tube {
  float axis[3], across[3];
  float along, square, c, half, extra;  // half: of the length, widened
};

SP_INLINE Tube make_tube(const Image& image, const float* center, const float* axis, float half,
                         float radius) {
  Tube tube;
  float m[3], away[3];
  subtract(image.p, center, m);
  tube.along = dot(m, axis);
  const float beyond = tube.along - clamp(tube.along, -half, half);
  for (int k = 0; k < 3; ++k) {
    tube.axis[k] = axis[k];
    tube.across[k] = m[k] - tube.along * axis[k];
    away[k] = -(tube.across[k] + beyond * axis[k]);
  }
  tube.extra = footprint(image, away);
  tube.half = half + tube.extra;
  tube.square = dot(tube.across, tube.across);
  const float wide = radius + tube.extra;
  tube.c = tube.square - wide * wide;
  return tube;
}

// `c` is the tube's or that of a wider one; returns false if all rays miss its infinite cylinder.
SP_INLINE bool see_tube(const Image& image, size_t i, const Tube& tube, float c) {
  const F16 slope = dot_rays(image, i, tube.axis), b = dot_rays(image, i, tube.across);
  const F16 a = max(load(image.square + i) - slope * slope, F16(kParallel));
  if (!any(b * b - a * F16(c) > F16(0.0f))) return false;
  const F16 discriminant = b * b - a * F16(tube.c);
  const F16 root = sqrt(max(discriminant, F16(0.0f))), per_a = F16(1.0f) / a;
  const F16 per_slope = F16(1.0f) / (slope + F16(kParallel));
  const F16 middle = F16(tube.along) * per_slope;  // between the flat ends
  const F16 width = F16(tube.half) * max(per_slope, -per_slope);
  see(image, i, max((-b - root) * per_a, -(width + middle)),
      min((root - b) * per_a, width - middle), tube.extra);
  return true;
}

static void cast_sphere(const Image& image, const float* s) {
  const Sphere sphere = make_sphere(image, s, s[3]);
  for (size_t i = 0; i < image.size; i += kLanes) {
    if (may_be_seen(image, i)) see_sphere(image, i, sphere);
  }
}

static void cast_cylinder(const Image& image, const float* s) {
  const Tube tube = make_tube(image, s, s + 3, s[6], s[7]);
  for (size_t i = 0; i < image.size; i += kLanes) {
    if (may_be_seen(image, i)) see_tube(image, i, tube, tube.c);
  }
}

// A tube and a sphere at either end, which is wider than the tube if it is farther.
static void cast_capsule(const Image& image, const float* s) {
  float middle[3], end[3];
  for (int k = 0; k < 3; ++k) {
    end[k] = s[k] + s[6] * s[3 + k];
    middle[k] = s[k] + 0.5f * s[6] * s[3 + k];
  }
  const Tube tube = make_tube(image, middle, s + 3, 0.5f * s[6], s[7]);
  const Sphere ends[2] = {make_sphere(image, s, s[7]), make_sphere(image, end, s[7])};
  const float widest = s[7] + maximum(tube.extra, maximum(ends[0].extra, ends[1].extra));
  const float c = tube.square - widest * widest * 1.001f;
  for (size_t i = 0; i < image.size; i += kLanes) {
    if (!may_be_seen(image, i) || !see_tube(image, i, tube, c)) continue;
    see_sphere(image, i, ends[0]);
    see_sphere(image, i, ends[1]);
  }
}

static void cast_box(const Image& image, const float* center, const float* rotation,
                     const float* half) {
  float m[3], axes[3][3], local[3], away[3] = {0.0f, 0.0f, 0.0f};
  subtract(image.p, center, m);
  for (int k = 0; k < 3; ++k) {
    for (int j = 0; j < 3; ++j) axes[k][j] = rotation[3 * j + k];
    local[k] = dot(m, axes[k]);
    const float beyond = local[k] - clamp(local[k], -half[k], half[k]);
    for (int j = 0; j < 3; ++j) away[j] -= beyond * axes[k][j];
  }
  const float extra = footprint(image, away);
  for (size_t i = 0; i < image.size; i += kLanes) {
    if (!may_be_seen(image, i)) continue;
    F16 enter = F16(0.0f), leave = F16(kInfinity);
    for (int k = 0; k < 3; ++k) {
      const F16 per_slope = F16(1.0f) / (dot_rays(image, i, axes[k]) + F16(kParallel));
      const F16 middle = F16(local[k]) * per_slope;
      const F16 width = F16(half[k] + extra) * max(per_slope, -per_slope);
      leave = min(width - middle, leave);
      enter = max(-(width + middle), enter);
    }
    see(image, i, enter, leave, extra);
  }
}

static void cast_half_space(const Image& image, const float* R, const float* normal, float offset) {
  const float height = maximum(dot(image.p, normal) - offset, 0.0f);
  // A pixel's corner looks further down.
  const float right = R[0] * normal[0] + R[3] * normal[1] + R[6] * normal[2];
  const float down = R[1] * normal[0] + R[4] * normal[1] + R[7] * normal[2];
  const float tilt = image.half_pixel * (__builtin_fabsf(right) + __builtin_fabsf(down));
  for (size_t i = 0; i < image.size; i += kLanes) {
    const F16 fall = F16(tilt) - dot_rays(image, i, normal);
    const F16 depth = select(fall > F16(1e-6f), F16(height) / fall, F16(kInfinity));
    store(image.depth + i, min(depth, load(image.depth + i)));
  }
}

static void cast_body(const Image& image, uint8_t kind, const float* s) {
  switch (kind) {
    case kSphere:
      return cast_sphere(image, s);
    case kCapsule:
      return cast_capsule(image, s);
    case kCylinder:
      return cast_cylinder(image, s);
    default:
      return cast_box(image, s, s + 3, s + 12);
  }
}

// Writes the indices of the bodies that the camera may see and their minimum depths; returns their
// number.
static size_t visible_bodies(const ShapeWorld& world, const PixelRays& rays, const CameraPose& pose,
                             float* min_depths, float* seen) {
  // The camera's z axis and the inward normals of its view frustum, in W.
  const float local[5][3] = {{0.0f, 0.0f, 1.0f},
                             {1.0f, 0.0f, -rays.low[0]},
                             {-1.0f, 0.0f, rays.high[0]},
                             {0.0f, 1.0f, -rays.low[1]},
                             {0.0f, -1.0f, rays.high[1]}};
  float normals[5][3];
  for (int n = 0; n < 5; ++n) {
    const float size = length(local[n]);
    for (int k = 0; k < 3; ++k) normals[n][k] = dot(pose.R + 3 * k, local[n]) / size;
  }
  size_t count = 0;
  for (size_t i = 0; i < world.body_count; i += kLanes) {
    const auto bound = [&](int k) { return load(world.bounds + k * world.stride + i); };
    const F16 center[3] = {bound(0) - F16(pose.p[0]), bound(1) - F16(pose.p[1]),
                           bound(2) - F16(pose.p[2])};
    const F16 half[3] = {bound(3), bound(4), bound(5)};
    const auto middle = [&](const float* n) {
      return F16(n[0]) * center[0] + F16(n[1]) * center[1] + F16(n[2]) * center[2];
    };
    const auto reach = [&](const float* n) {
      return F16(__builtin_fabsf(n[0])) * half[0] + F16(__builtin_fabsf(n[1])) * half[1] +
             F16(__builtin_fabsf(n[2])) * half[2];
    };
    const F16 depth = middle(normals[0]), depth_reach = reach(normals[0]);
    const F16 max_depth = depth + depth_reach;
    const F16 extra = F16(rays.half_pixel) * max(max_depth, F16(0.0f));
    const F16 outside = -(F16(kCorner) * extra + F16(kSlack));
    Mask16 inside = max_depth > F16(-kSlack);
    for (int n = 1; n < 5; ++n) {
      inside = inside & (middle(normals[n]) + reach(normals[n]) > outside);
    }
    float depths[kLanes];
    store(depths, depth - depth_reach - F16(kCorner - 1.0f) * extra - F16(kSlack));
    uint32_t bits = lane_bits(inside);
    if (world.body_count - i < kLanes) bits &= (1u << (world.body_count - i)) - 1u;
    for (; bits; bits &= bits - 1u) {
      const int lane = __builtin_ctz(bits);
      const uint32_t body = static_cast<uint32_t>(i) + static_cast<uint32_t>(lane);
      min_depths[count] = depths[lane];
      std::memcpy(seen + count++, &body, sizeof(body));
    }
  }
  return count;
}

// Sorts two arrays by the first of them, ascending.
static void sort_pairs(float* keys, float* values, size_t count) {
  for (size_t gap = count / 2; gap > 0; gap = gap == 2 ? 1 : gap * 5 / 11) {
    for (size_t i = gap; i < count; ++i) {
      const float key = keys[i], value = values[i];
      size_t k = i;
      for (; k >= gap && keys[k - gap] > key; k -= gap) {
        keys[k] = keys[k - gap];
        values[k] = values[k - gap];
      }
      keys[k] = key;
      values[k] = value;
    }
  }
}

static void cast_shapes(const ShapeWorld& world, const PixelRays& rays, const CameraPose& pose,
                        float* scratch, float* depth) {
  float ahead[3];
  Image image = begin_image(rays, pose, scratch, ahead);
  float* min_depths = scratch + 5 * image.size;
  float* seen = min_depths + world.body_count;
  for (size_t i = 0; i < world.half_space_count; ++i) {
    const float* s = world.half_spaces + i * kShapeSize;
    cast_half_space(image, pose.R, s, s[3]);
  }
  const size_t count = visible_bodies(world, rays, pose, min_depths, seen);
  sort_pairs(min_depths, seen, count);  // near bodies hide far ones
  for (size_t i = 0; i < count; ++i) {
    uint32_t body;
    std::memcpy(&body, seen + i, sizeof(body));
    image.min_depth = min_depths[i];
    cast_body(image, world.kinds[body], world.bodies + static_cast<size_t>(body) * kShapeSize);
  }
  write_image(image, rays, depth);
}

// Grids.

constexpr int kMaxSteps = 256;
constexpr float kTolerance = 0.01f;  // [-] of a voxel
// Voxels beyond the grid where surfaces still count, such as floors at its bounds.
constexpr float kBeyond = 0.5f;

static float interpolate(const GridWorld& grid, const float* p, float* gradient) {
  size_t cell = 0;
  float f[3];
  for (int k = 0; k < 3; ++k) {
    const float last = static_cast<float>(grid.shape[k] - 1);
    const float at = clamp((p[k] - grid.first_center[k]) / grid.voxel_size, 0.0f, last);
    const int32_t below = static_cast<int32_t>(at), last_cell = grid.shape[k] - 2;
    const int32_t i = below < last_cell ? below : last_cell;
    cell = cell * static_cast<size_t>(grid.shape[k]) + static_cast<size_t>(i);
    f[k] = at - static_cast<float>(i);
  }
  const size_t stride_y = static_cast<size_t>(grid.shape[2]);
  const size_t stride_x = static_cast<size_t>(grid.shape[1]) * stride_y;
  const float value = trilinear(grid.values + cell, stride_x, stride_y, f, gradient);
  for (int k = 0; k < 3; ++k) gradient[k] /= grid.voxel_size;
  return value;
}

// The interpolant at points in voxels from the first center, extrapolated beyond the outermost.
SP_INLINE F16 interpolate(const GridWorld& grid, const F16* at) {
  I16 cell = to_int(F16(0.0f));
  F16 f[3];
  for (int k = 0; k < 3; ++k) {
    const F16 last = F16(static_cast<float>(grid.shape[k] - 2));
    const I16 i = to_int(clamp(at[k], F16(0.0f), last));
    cell = multiply(cell, grid.shape[k]) + i;
    f[k] = at[k] - to_float(i);
  }
  const int32_t stride_y = grid.shape[2], stride_x = grid.shape[1] * stride_y;
  const auto along_z = [&](int32_t offset) {
    const F16 low = load_at(grid.values + offset, cell);
    return low + f[2] * (load_at(grid.values + offset + 1, cell) - low);
  };
  const auto along_yz = [&](int32_t offset) {
    const F16 low = along_z(offset);
    return low + f[1] * (along_z(offset + stride_y) - low);
  };
  const F16 low = along_yz(0);
  return low + f[0] * (along_yz(stride_x) - low);
}

// Sphere tracing, with distances reduced by half the width of the pixel.
static void cast_grid(const GridWorld& grid, const PixelRays& rays, const CameraPose& pose,
                      float* scratch, float* depth) {
  float ahead[3];
  const Image image = begin_image(rays, pose, scratch, ahead);
  const float* directions[3] = {image.x, image.y, image.z};
  const F16 per_voxel = F16(1.0f / grid.voxel_size), zero = F16(0.0f);
  for (size_t i = 0; i < image.size; i += kLanes) {
    F16 origin[3], slope[3], enter = zero, leave = F16(kInfinity);
    for (int k = 0; k < 3; ++k) {
      origin[k] = F16((pose.p[k] - grid.first_center[k]) / grid.voxel_size);
      slope[k] = load(directions[k] + i) * per_voxel;
      const float half = 0.5f * static_cast<float>(grid.shape[k]);
      const F16 per_slope = F16(1.0f) / (slope[k] + F16(kParallel));
      const F16 middle = (origin[k] + F16(0.5f - half)) * per_slope;
      const F16 width = F16(half + kBeyond) * max(per_slope, -per_slope);
      leave = min(width - middle, leave);
      enter = max(-(width + middle), enter);
    }
    const F16 speed = sqrt(load(image.square + i));
    const F16 widening = F16(rays.half_pixel) / speed;
    const F16 approach = F16(1.0f) / (speed + widening);
    F16 t = enter;
    Mask16 under_way = t < leave;
    for (int step = 0; step < kMaxSteps && any(under_way); ++step) {
      const F16 at[3] = {origin[0] + t * slope[0], origin[1] + t * slope[1],
                         origin[2] + t * slope[2]};
      const F16 clearance = interpolate(grid, at) - t * widening;
      t += zero_unless(under_way, max(clearance, zero) * approach);
      under_way = under_way & (clearance > F16(kTolerance * grid.voxel_size)) & (t < leave);
    }
    store(image.depth + i, select(t < leave, t + t * widening, F16(kInfinity)));
  }
  write_image(image, rays, depth);
}

// Nearest shapes.

// Distance to a body, or for higher indices to a half space.
static float shape_distance(const ShapeWorld& world, size_t shape, const float* p,
                            float* gradient) {
  if (shape >= world.body_count) {
    const float* s = world.half_spaces + (shape - world.body_count) * kShapeSize;
    return shape_distance(kHalfSpace, s, p, gradient);
  }
  return shape_distance(world.kinds[shape], world.bodies + shape * kShapeSize, p, gradient);
}

static void nearest_shapes(const ShapeWorld& world, const float* p, size_t count, float* distances,
                           float* gradients) {
  size_t shapes[kMaxNearest];
  for (size_t i = 0; i < count; ++i) distances[i] = __builtin_inff();
  const auto consider = [&](size_t shape) {
    const float distance = shape_distance(world, shape, p, nullptr);
    if (!(distance < distances[count - 1])) return;
    size_t k = count - 1;
    for (; k > 0 && distance < distances[k - 1]; --k) {
      distances[k] = distances[k - 1];
      shapes[k] = shapes[k - 1];
    }
    distances[k] = distance;
    shapes[k] = shape;
  };
  for (size_t i = 0; i < world.half_space_count; ++i) consider(world.body_count + i);
  for (size_t i = 0; i < world.body_count; i += kLanes) {
    F16 square = F16(0.0f);  // of the distance to the bounding boxes
    for (int k = 0; k < 3; ++k) {
      const F16 away = load(world.bounds + k * world.stride + i) - F16(p[k]);
      const F16 beyond = max(away, -away) - load(world.bounds + (k + 3) * world.stride + i);
      const F16 outside = max(beyond, F16(0.0f));
      square += outside * outside;
    }
    const float max_distance = maximum(distances[count - 1], 0.0f);
    uint32_t bits = lane_bits(square <= F16(max_distance * max_distance));
    if (world.body_count - i < kLanes) bits &= (1u << (world.body_count - i)) - 1u;
    for (; bits; bits &= bits - 1u) consider(i + static_cast<size_t>(__builtin_ctz(bits)));
  }
  for (size_t i = 0; i < count; ++i) {
    float* gradient = gradients + 3 * i;
    if (distances[i] < __builtin_inff()) {
      shape_distance(world, shapes[i], p, gradient);
    } else {
      for (int k = 0; k < 3; ++k) gradient[k] = 0.0f;
    }
  }
}

extern const CastingKernels kCastingKernels;
const CastingKernels kCastingKernels = {casting_scratch, cast_shapes, cast_grid, nearest_shapes,
                                        interpolate};

}  // namespace splatpilot::SIMD_LEVEL
