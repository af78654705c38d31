#include "project/camera.hpp"

#include <algorithm>
#include <cmath>

namespace splatpilot {

namespace {

// Clamps slopes and bounds the sides of the image, of rows n (3) and reach (1).
void bound(Camera& c, const double min_slope[2], const double max_slope[2],
           const double sides[4][4]) {
  c.min_slope_x = static_cast<float>(min_slope[0]);
  c.max_slope_x = static_cast<float>(max_slope[0]);
  c.min_slope_y = static_cast<float>(min_slope[1]);
  c.max_slope_y = static_cast<float>(max_slope[1]);
  for (int side = 0; side < 4; ++side) {
    for (int axis = 0; axis < 3; ++axis) {
      c.side_normal[side][axis] = static_cast<float>(sides[side][axis]);
    }
    c.side_reach[side] = static_cast<float>(1.01 * kMaxExtent * sides[side][3]);
  }
}

void bound_by_pinhole(const CameraParameters& p, Camera& c) {
  const double fx = p.K[0], cx = p.K[2], fy = p.K[4], cy = p.K[5];
  // The slopes x/z and y/z that enter the Jacobian stay within the whole image plus 15 % of its
  // size.
  const double top = -p.rows_above, bottom = p.height + p.rows_below;
  const double margin_x = 0.15 * p.width / fx, margin_y = 0.15 * (bottom - top) / fy;
  const double low[2] = {-cx / fx - margin_x, (top - cy) / fy - margin_y};
  const double high[2] = {(p.width - cx) / fx + margin_x, (bottom - cy) / fy + margin_y};
  // |J_x| <= fx / z sqrt(1 + slope^2), so the extent is at most kMaxExtent (|J_x| s + sqrt(eps2d)):
  // left of the image means fx x / z + cx + extent <= 0, which times z is linear. A pixel and 1 %
  // are added for rounding.
  const double reach_x = fx * std::sqrt(1.0 + std::max(low[0] * low[0], high[0] * high[0]));
  const double reach_y = fy * std::sqrt(1.0 + std::max(low[1] * low[1], high[1] * high[1]));
  const double blur = kMaxExtent * std::sqrt(p.eps2d) + 1.0;
  const double sides[4][4] = {{fx, 0, cx + blur, reach_x},
                              {-fx, 0, p.width - cx + blur, reach_x},
                              {0, fy, cy + blur, reach_y},
                              {0, -fy, p.height - cy + blur, reach_y}};
  bound(c, low, high, sides);
}

// The rays of a lens lie in a frustum, and Gaussians up to their extent.
void bound_by_frustum(const CameraParameters& p, Camera& c) {
  double sides[4][4] = {{1, 0, -p.min_side[0], 1},
                        {-1, 0, p.max_side[0], 1},
                        {0, 1, -p.min_side[1], 1},
                        {0, -1, p.max_side[1], 1}};
  for (auto& n : sides) {
    const double length = std::hypot(n[0], n[1], n[2]);
    for (int axis = 0; axis < 3; ++axis) n[axis] /= length;
  }
  bound(c, p.min_slope, p.max_slope, sides);
}

}  // namespace

Camera make_camera(const CameraParameters& p) {
  Camera c{};
  c.width = p.width;
  c.height = p.height;
  c.fx = static_cast<float>(p.K[0]);
  c.fy = static_cast<float>(p.K[4]);
  c.cx = static_cast<float>(p.K[2]);
  c.cy = static_cast<float>(p.K[5]);
  c.near_plane = static_cast<float>(p.near_plane);
  c.far_plane = static_cast<float>(p.far_plane);
  // A splat is clipped when its radius, rounded up, does not exceed the limit.
  c.radius_clip = static_cast<float>(std::floor(p.radius_clip));
  c.eps2d = static_cast<float>(p.eps2d);
  c.antialiased = p.antialiased;
  c.max_depth = static_cast<float>(p.max_depth);
  c.merged_spread = static_cast<float>(p.merged_spread);

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
    bound_by_pinhole(p, c);
  } else {
    bound_by_frustum(p, c);
  }
  return c;
}

}  // namespace splatpilot
