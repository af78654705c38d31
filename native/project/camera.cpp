#include "project/camera.hpp"

#include <algorithm>
#include <cmath>
#include <limits>

namespace splatpilot {

namespace {

void hold_in_pinhole(const CameraParameters& p, Camera& c) {
  const double fx = p.K[0], cx = p.K[2], fy = p.K[4], cy = p.K[5];
  // The slopes x/z and y/z that enter the Jacobian stay within the image plus 15 % of its size.
  const double margin_x = 0.15 * p.width / fx, margin_y = 0.15 * p.height / fy;
  const double min_x = -cx / fx - margin_x, max_x = (p.width - cx) / fx + margin_x;
  const double min_y = -cy / fy - margin_y, max_y = (p.height - cy) / fy + margin_y;
  c.min_slope_x = static_cast<float>(min_x);
  c.max_slope_x = static_cast<float>(max_x);
  c.min_slope_y = static_cast<float>(min_y);
  c.max_slope_y = static_cast<float>(max_y);

  // |J_x| <= fx / z sqrt(1 + slope^2), so the extent is at most kMaxExtent (|J_x| s + sqrt(eps2d)):
  // left of the image means fx x / z + cx + extent <= 0, which times z is linear. A pixel and 1 %
  // are added for rounding.
  const double steep_x = std::sqrt(1.0 + std::max(min_x * min_x, max_x * max_x));
  const double steep_y = std::sqrt(1.0 + std::max(min_y * min_y, max_y * max_y));
  const double blur = kMaxExtent * std::sqrt(p.eps2d) + 1.0;
  const double sides[4][4] = {{fx, 0, cx + blur, fx * steep_x},
                              {-fx, 0, p.width - cx + blur, fx * steep_x},
                              {0, fy, cy + blur, fy * steep_y},
                              {0, -fy, p.height - cy + blur, fy * steep_y}};
  for (int side = 0; side < 4; ++side) {
    for (int axis = 0; axis < 3; ++axis) {
      c.side_normal[side][axis] = static_cast<float>(sides[side][axis]);
    }
    c.side_reach[side] = static_cast<float>(1.01 * kMaxExtent * sides[side][3]);
  }
}

// What a lens shows lies in a frustum too, and so do Gaussians, but for their extent.
void hold_in_frustum(const CameraParameters& p, Camera& c) {
  c.min_slope_x = static_cast<float>(p.min_slope[0]);
  c.max_slope_x = static_cast<float>(p.max_slope[0]);
  c.min_slope_y = static_cast<float>(p.min_slope[1]);
  c.max_slope_y = static_cast<float>(p.max_slope[1]);
  const double sides[4][3] = {{1, 0, -p.min_slope[0]},
                              {-1, 0, p.max_slope[0]},
                              {0, 1, -p.min_slope[1]},
                              {0, -1, p.max_slope[1]}};
  for (int side = 0; side < 4; ++side) {
    const double length = std::hypot(sides[side][0], sides[side][1], sides[side][2]);
    for (int axis = 0; axis < 3; ++axis) {
      c.side_normal[side][axis] = static_cast<float>(sides[side][axis] / length);
    }
    c.side_reach[side] = static_cast<float>(1.01 * kMaxExtent);
  }
}

}  // namespace

Camera make_camera(const CameraParameters& p) {
  Camera c{};
  c.width = p.width;
  c.height = p.height;
  const double fx = p.K[0], cx = p.K[2], fy = p.K[4], cy = p.K[5];
  c.fx = static_cast<float>(fx);
  c.fy = static_cast<float>(fy);
  c.cx = static_cast<float>(cx);
  c.cy = static_cast<float>(cy);
  c.near_plane = static_cast<float>(p.near_plane);
  c.far_plane = static_cast<float>(p.far_plane);
  // A splat is clipped when its radius, rounded up, does not exceed the limit.
  c.radius_clip = static_cast<float>(std::floor(p.radius_clip));
  c.eps2d = static_cast<float>(p.eps2d);
  c.antialiased = p.antialiased;
  c.max_depth = std::numeric_limits<float>::infinity();

  // center = -R^-1 t by cofactors: R may be a rotation only to single precision.
  double R[3][3], t[3];
  for (int i = 0; i < 3; ++i) {
    for (int j = 0; j < 3; ++j) {
      R[i][j] = p.X_CW[4 * i + j];
      c.R_CW[3 * i + j] = static_cast<float>(R[i][j]);
    }
    t[i] = p.X_CW[4 * i + 3];
  }
  double cofactor[3][3], det = 0.0;
  for (int i = 0; i < 3; ++i) {
    for (int j = 0; j < 3; ++j) {
      const int i1 = (i + 1) % 3, i2 = (i + 2) % 3, j1 = (j + 1) % 3, j2 = (j + 2) % 3;
      cofactor[i][j] = R[i1][j1] * R[i2][j2] - R[i1][j2] * R[i2][j1];
    }
  }
  for (int j = 0; j < 3; ++j) det += R[0][j] * cofactor[0][j];
  for (int j = 0; j < 3; ++j) {
    double center = 0.0;
    for (int i = 0; i < 3; ++i) center -= cofactor[i][j] * t[i] / det;
    c.center_high[j] = static_cast<float>(center);
    c.center_low[j] = static_cast<float>(center - c.center_high[j]);
  }

  c.distortion = p.distortion;
  if (p.distortion.model == DistortionModel::kNone) {
    hold_in_pinhole(p, c);
  } else {
    hold_in_frustum(p, c);
  }
  return c;
}

}  // namespace splatpilot
