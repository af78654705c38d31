// Signed distances to shapes, as `splatpilot.systems.collision.shapes` defines them.
#pragma once

#include "casting/ray_casting.hpp"
#include "core/vectors.hpp"

namespace splatpilot::SIMD_LEVEL {

// Brings a to unit length; of no length it becomes perpendicular to the unit vector `axis`.
SP_INLINE void normalise(float* a, const float* axis) {
  float size = length(a);
  if (size == 0.0f) {
    int least = 0;
    for (int k = 1; k < 3; ++k) {
      if (__builtin_fabsf(axis[k]) < __builtin_fabsf(axis[least])) least = k;
    }
    const int next = (least + 1) % 3, last = (least + 2) % 3;
    a[next] = axis[last];
    a[last] = -axis[next];
    size = length(a);
  }
  for (int k = 0; k < 3; ++k) a[k] /= size;
}

// `gradient` may be null.
static float sphere_distance(const float* p, const float* center, float radius, float* gradient) {
  const float up[3] = {0.0f, 0.0f, 1.0f};
  float away[3];
  subtract(p, center, away);
  const float distance = length(away) - radius;
  if (gradient) {
    normalise(away, up);
    std::memcpy(gradient, away, sizeof(away));
  }
  return distance;
}

static float capsule_distance(const float* p, const float* s, float* gradient) {
  float away[3];
  subtract(p, s, away);
  const float along = clamp(dot(away, s + 3), 0.0f, s[6]);
  for (int k = 0; k < 3; ++k) away[k] -= along * s[3 + k];
  const float distance = length(away) - s[7];
  if (gradient) {
    normalise(away, s + 3);
    std::memcpy(gradient, away, sizeof(away));
  }
  return distance;
}

static float cylinder_distance(const float* p, const float* s, float* gradient) {
  const float* axis = s + 3;
  float radial[3];
  subtract(p, s, radial);
  const float along = dot(radial, axis);
  for (int k = 0; k < 3; ++k) radial[k] -= along * axis[k];
  const float beyond_end = __builtin_fabsf(along) - s[6], beyond_side = length(radial) - s[7];
  float end = maximum(beyond_end, 0.0f), side = maximum(beyond_side, 0.0f);
  const float inner = maximum(beyond_end, beyond_side);
  const float distance = inner > 0.0f ? __builtin_sqrtf(end * end + side * side) : inner;
  if (gradient) {
    if (!(inner > 0.0f)) {
      end = beyond_end >= beyond_side ? 1.0f : 0.0f;
      side = 1.0f - end;
    }
    const float size = __builtin_sqrtf(end * end + side * side);
    normalise(radial, axis);
    end = __builtin_copysignf(end, along);
    for (int k = 0; k < 3; ++k) gradient[k] = (end * axis[k] + side * radial[k]) / size;
  }
  return distance;
}

static float box_distance(const float* p, const float* s, float* gradient) {
  const float *rotation = s + 3, *half = s + 12;
  float m[3], local[3], beyond[3], way[3];
  subtract(p, s, m);
  int deepest = 0;
  for (int k = 0; k < 3; ++k) {
    local[k] = m[0] * rotation[k] + m[1] * rotation[3 + k] + m[2] * rotation[6 + k];
    beyond[k] = __builtin_fabsf(local[k]) - half[k];
    way[k] = maximum(beyond[k], 0.0f);
    if (beyond[k] > beyond[deepest]) deepest = k;
  }
  const bool outside = beyond[deepest] > 0.0f;
  const float distance = outside ? length(way) : beyond[deepest];
  if (gradient) {
    const float size = outside ? distance : 1.0f;
    for (int k = 0; k < 3; ++k) {
      const float w = outside ? way[k] : (k == deepest ? 1.0f : 0.0f);
      way[k] = __builtin_copysignf(w / size, local[k]);
    }
    for (int k = 0; k < 3; ++k) gradient[k] = dot(rotation + 3 * k, way);
  }
  return distance;
}

static float half_space_distance(const float* p, const float* s, float* gradient) {
  if (gradient) std::memcpy(gradient, s, 3 * sizeof(float));
  return dot(p, s) - s[3];
}

// Of a body, or after them of a half space.
static float shape_distance(const ShapeWorld& world, size_t shape, const float* p,
                            float* gradient) {
  if (shape >= world.body_count) {
    const float* s = world.half_spaces + (shape - world.body_count) * kShapeSize;
    return half_space_distance(p, s, gradient);
  }
  const float* s = world.bodies + shape * kShapeSize;
  switch (world.kinds[shape]) {
    case kSphere:
      return sphere_distance(p, s, s[3], gradient);
    case kCapsule:
      return capsule_distance(p, s, gradient);
    case kCylinder:
      return cylinder_distance(p, s, gradient);
    default:
      return box_distance(p, s, gradient);
  }
}

static void nearest_shapes(const ShapeWorld& world, const float* p, size_t count, float* distances,
                           float* gradients) {
  size_t shapes[kMostNearest];
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
    const float farthest = maximum(distances[count - 1], 0.0f);
    uint32_t bits = lane_bits(square <= F16(farthest * farthest));
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

}  // namespace splatpilot::SIMD_LEVEL
