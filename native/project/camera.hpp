// Cameras of users, and their preparation for the kernels.
#pragma once

#include "core/types.hpp"

namespace splatpilot {

// [px^2] blur of depth images without color: hides no pixel from a footprint without blur, and
// suffices for needles in float32.
constexpr float kDepthBlur = 1e-4f;

struct CameraParameters {
  int width, height;
  double K[9];                   // row-major, [px]; skew is ignored
  double X_CW[16];               // world to camera, row-major
  double near_plane, far_plane;  // [m]
  double max_depth;              // [m], of the median depth
  double merged_spread;          // [px] of baked Gaussians that are drawn as one
  double radius_clip, eps2d;     // [px], [px^2]
  bool antialiased;
  Distortion distortion;
  int rows_above, rows_below;  // of these rows in the whole image
  // Bounds of the slopes x/z, y/z of rays that meet the whole image, or these rows, or their
  // surroundings through a lens.
  double min_slope[2], max_slope[2], min_side[2], max_side[2];
};

Camera make_camera(const CameraParameters& parameters);

}  // namespace splatpilot
