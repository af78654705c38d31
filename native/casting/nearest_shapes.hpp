// The shapes of a world that are nearest to a point.
#pragma once

#include "core/simd.hpp"
#include "fields/shape_distances.hpp"

namespace splatpilot::SIMD_LEVEL {

// Of a body, or after them of a half space.
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
