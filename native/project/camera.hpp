// From what users know of a camera to what the kernels need.
#pragma once

#include "core/types.hpp"

namespace splatpilot {

// Where there is no color, what is left of the blur [px^2]: so little that it hides no pixel from
// a footprint without any, and enough that needles are found in float32.
constexpr float kDepthBlur = 1e-4f;

struct CameraParameters {
  int width, height;
  double K[9];                   // row-major, [px]; skew is ignored
  double X_CW[16];               // world to camera, row-major
  double near_plane, far_plane;  // [m]
  double radius_clip, eps2d;     // [px], [px^2]
  bool antialiased;
  Distortion distortion;
  // Between which the slopes x/z, y/z of rays lie that meet the image or what is near it, where
  // the lens distorts.
  double min_slope[2], max_slope[2];
};

Camera make_camera(const CameraParameters& parameters);

}  // namespace splatpilot
