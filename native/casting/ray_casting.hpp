// Depth images of small cameras and distances of points in many worlds, each of analytic shapes or
// of a regular grid; the table of their kernels exists once per SIMD level. Plain data only, as in
// types.hpp.
//
// A pixel sees what any part of it sees: a surface is seen by rays that pass it within half the
// width of a pixel there, at the depth where what is widened by so much begins plus that much.
#pragma once

#include <cstddef>
#include <cstdint>

namespace splatpilot {

// In the order of the numbers that Python gives them.
enum ShapeKind : uint8_t { kSphere, kCapsule, kCylinder, kBox, kHalfSpace, kShapeKinds };

// A row of them describes a shape [m]: center and radius of a sphere; end, axis, length and radius
// of a capsule; center, axis, half length and radius of a cylinder; center, rotation row by row and
// half sizes of a box; outward normal and offset of a half space.
constexpr int kShapeSize = 15;

constexpr size_t kMostNearest = 16;

// The shapes of one world: bodies, which have bounding boxes, and half spaces.
struct ShapeWorld {
  const float* bodies;  // rows of kShapeSize
  const uint8_t* kinds;
  size_t body_count;
  // Centers x, y, z and half sizes x, y, z of bounding boxes: six arrays `stride` apart, which may
  // be read in whole packs.
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

// The rays of a camera in its own frame, z = 1, neighbors in columns: much of what stands upright
// is missed by whole packs of such.
struct PixelRays {
  const float *x, *y;      // readable in whole packs, whose last ones are filled with rays
  const uint32_t* pixels;  // of which each ray is
  size_t count;
  float low[2], high[2];  // bounds of x and y
  float half_pixel;       // half the width of a pixel at depth 1
};

struct CameraPose {
  float p[3];  // [m], in W
  float R[9];  // R_WC row by row
};

struct CastingKernels {
  // Floats of scratch memory for `cast_shapes` of so many rays and bodies, and for `cast_grid`.
  size_t (*scratch)(size_t rays, size_t bodies);
  // Planar depth [m] of each ray, infinite where nothing is hit.
  void (*cast_shapes)(const ShapeWorld&, const PixelRays&, const CameraPose&, float* scratch,
                      float* depth);
  // The same where values are signed distances [m] to surfaces. Nothing is hit further than
  // half a voxel beyond the grid.
  void (*cast_grid)(const GridWorld&, const PixelRays&, const CameraPose&, float* scratch,
                    float* depth);
  // Signed distances [m] of the `count` shapes nearest to p, nearest first, and their gradients
  // (count, 3); infinite and 0 for shapes that there are not.
  void (*nearest_shapes)(const ShapeWorld&, const float* p, size_t count, float* distances,
                         float* gradients);
  // The trilinear interpolant at p and its gradient [1/m]; beyond the outermost centers of voxels
  // those at the nearest point of the box that they span.
  float (*interpolate)(const GridWorld&, const float* p, float* gradient);
};

}  // namespace splatpilot
