// Rays cast at shapes, 16 at a time.
#pragma once

#include "raster/depth_image.hpp"

namespace splatpilot::SIMD_LEVEL {

constexpr float kSlack = 1e-3f;  // [m], of what is left out, for rounding
// Widened by e, a shape is nowhere more than this times e beyond where it was: at corners of boxes.
constexpr float kCorner = 1.7320509f;

// A sphere widened by half a pixel, from the camera.
struct Ball {
  float m[3], c, extra;  // c: the square of the distance beyond its surface, about
};

SP_INLINE Ball make_ball(const Image& image, const float* center, float radius) {
  Ball ball;
  float away[3];
  subtract(image.p, center, ball.m);
  subtract(center, image.p, away);
  ball.extra = footprint(image, away);
  const float wide = radius + ball.extra;
  ball.c = dot(ball.m, ball.m) - wide * wide;
  return ball;
}

SP_INLINE void see_ball(const Image& image, size_t i, const Ball& ball) {
  const F16 a = load(image.square + i), b = dot_rays(image, i, ball.m);
  const F16 discriminant = b * b - a * F16(ball.c);
  if (!any(discriminant > F16(0.0f))) return;
  const F16 root = sqrt(max(discriminant, F16(0.0f))), per_a = F16(1.0f) / a;
  see(image, i, (-b - root) * per_a, (root - b) * per_a, ball.extra);
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

// `c` is the tube's, or that of a wider one; false where its endless cylinder is missed.
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
  const Ball ball = make_ball(image, s, s[3]);
  for (size_t i = 0; i < image.size; i += kLanes) {
    if (may_be_seen(image, i)) see_ball(image, i, ball);
  }
}

static void cast_cylinder(const Image& image, const float* s) {
  const Tube tube = make_tube(image, s, s + 3, s[6], s[7]);
  for (size_t i = 0; i < image.size; i += kLanes) {
    if (may_be_seen(image, i)) see_tube(image, i, tube, tube.c);
  }
}

// A tube and a ball at either end, which may be wider than it: farther ends are seen wider.
static void cast_capsule(const Image& image, const float* s) {
  float middle[3], end[3];
  for (int k = 0; k < 3; ++k) {
    end[k] = s[k] + s[6] * s[3 + k];
    middle[k] = s[k] + 0.5f * s[6] * s[3 + k];
  }
  const Tube tube = make_tube(image, middle, s + 3, 0.5f * s[6], s[7]);
  const Ball balls[2] = {make_ball(image, s, s[7]), make_ball(image, end, s[7])};
  const float widest = s[7] + maximum(tube.extra, maximum(balls[0].extra, balls[1].extra));
  const float c = tube.square - widest * widest * 1.001f;
  for (size_t i = 0; i < image.size; i += kLanes) {
    if (!may_be_seen(image, i) || !see_tube(image, i, tube, c)) continue;
    see_ball(image, i, balls[0]);
    see_ball(image, i, balls[1]);
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

// The bodies that the camera may see, as numbers in `seen`, and the depths that they have at least;
// how many.
static size_t visible_bodies(const ShapeWorld& world, const PixelRays& rays, const CameraPose& pose,
                             float* least, float* seen) {
  // The camera's z axis and the inward normals of the pyramid that it sees, in W.
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
    const F16 farthest = depth + depth_reach;
    const F16 extra = F16(rays.half_pixel) * max(farthest, F16(0.0f));
    const F16 outside = -(F16(kCorner) * extra + F16(kSlack));
    Mask16 inside = farthest > F16(-kSlack);
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
      least[count] = depths[lane];
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
  float* least = scratch + 5 * image.size;
  float* seen = least + world.body_count;
  for (size_t i = 0; i < world.half_space_count; ++i) {
    const float* s = world.half_spaces + i * kShapeSize;
    cast_half_space(image, pose.R, s, s[3]);
  }
  const size_t count = visible_bodies(world, rays, pose, least, seen);
  sort_pairs(least, seen, count);  // what is near hides what is far
  for (size_t i = 0; i < count; ++i) {
    uint32_t body;
    std::memcpy(&body, seen + i, sizeof(body));
    image.least = least[i];
    cast_body(image, world.kinds[body], world.bodies + static_cast<size_t>(body) * kShapeSize);
  }
  write_image(image, rays, depth);
}

}  // namespace splatpilot::SIMD_LEVEL
