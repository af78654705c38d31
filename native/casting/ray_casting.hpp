// Depth images of small cameras and distances of points in many worlds, each of analytic shapes or
// of a regular grid. Plain data, as in types.hpp.
//
// A ray hits surfaces within half the width of a pixel of it, at the depth where the surface
// widened by so much begins, plus that much.
#pragma once

#include <cstddef>
#include <cstdint>

namespace splatpilot {

enum ShapeKind : uint8_t { kSphere, kCapsule, kCylinder, kBox, kHalfSpace, kShapeKinds };

// A shape is a row of numbers [m]: center and radius of a sphere; end, axis, length and radius
// of a capsule; center, axis, half length and radius of a cylinder; center, rotation row by row and
// half sizes of a box; outward normal and offset of a half space.
constexpr int kShapeSize = 15;

constexpr size_t kMaxNearest = 16;

// The shapes of one world: bodies, which have bounding boxes, and half spaces.
struct ShapeWorld {
  const float* bodies;  // rows of kShapeSize
  const uint8_t* kinds;
  size_t body_count;
  // Centers x, y, z and half sizes x, y, z of bounding boxes: six arrays `stride` apart, readable
  // in whole packs.
  const float* bounds;
  size_t stride;
  const float* half_spaces;  // rows of kShapeSize
  size_t half_space_count;
};

// Values at the centers of voxels, the last axis fastest.
struct GridWorld {
  const float* values;
  int32_t shape[3];
  float first_center[3];  // [m]
  float voxel_size;       // [m]
};

// The rays of a camera in its own frame, z = 1, in packs of columns: whole packs miss most upright
// shapes.
struct PixelRays {
  const float *x, *y;      // padded to whole packs with rays
  const uint32_t* pixels;  // index of each ray
  size_t count;
  float low[2], high[2];  // bounds of x and y
  float half_pixel;       // half the width of a pixel at depth 1
};

struct CameraPose {
  float p[3];  // [m], in W
  float R[9];  // R_WC row by row
};

struct CastingKernels {
  // Floats of scratch memory for `cast_shapes` and `cast_grid`.
  size_t (*scratch)(size_t rays, size_t bodies);
  // Planar depth [m] of each ray, infinite without a hit.
  void (*cast_shapes)(const ShapeWorld&, const PixelRays&, const CameraPose&, float* scratch,
                      float* depth);
  // The same for values that are signed distances [m], up to half a voxel beyond the grid.
  void (*cast_grid)(const GridWorld&, const PixelRays&, const CameraPose&, float* scratch,
                    float* depth);
  // Signed distances [m] of the `count` shapes nearest to p, nearest first, and their gradients
  // (count, 3); infinite and 0 beyond the number of shapes.
  void (*nearest_shapes)(const ShapeWorld&, const float* p, size_t count, float* distances,
                         float* gradients);
  // The trilinear interpolant at p, clamped to the outermost centers of voxels, and its gradient
  // [1/m].
  float (*interpolate)(const GridWorld&, const float* p, float* gradient);
};

}  // namespace splatpilot
