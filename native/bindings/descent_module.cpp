// Python binding of ways down a time of arrival, in double precision: see
// `splatpilot.systems.policies.time_of_arrival`.
#include "bindings/bindings.hpp"

namespace splatpilot {
namespace {

using namespace nb::literals;
using Times = Floats<nb::ndim<3>>;
using Point = Doubles<nb::shape<3>>;
using WayPoints = nb::ndarray<double, nb::shape<-1, 4>, nb::c_contig, nb::device::cpu>;

struct Vector {
  double x, y, z;

  Vector operator-(const Vector& other) const { return {x - other.x, y - other.y, z - other.z}; }
  Vector operator/(double s) const { return {x / s, y / s, z / s}; }
  double length() const { return std::sqrt(x * x + y * y + z * z); }
  // Zero stays zero.
  Vector unit() const { return length() > 0.0 ? *this / length() : *this; }
};

Vector vector(const Point& p) { return {p.data()[0], p.data()[1], p.data()[2]}; }

class TimeGrid {
 public:
  TimeGrid(const Times& times, const Vector& lower_W, double voxel_size)
      : times_(times.data()), lower_W_(lower_W), voxel_size_(voxel_size) {
    for (int k = 0; k < 3; ++k) {
      shape_[k] = static_cast<int64_t>(times.shape(k));
      require(shape_[k] >= 2, "a grid needs at least 2 voxels along each axis");
    }
  }

  // The gradient of the trilinear interpolation; differences are of single precision, as there.
  Vector gradient(const Vector& p_WQ) const {
    const double p[3] = {p_WQ.x, p_WQ.y, p_WQ.z};
    const double lower[3] = {lower_W_.x, lower_W_.y, lower_W_.z};
    int64_t cell[3];
    double f[3];
    for (int k = 0; k < 3; ++k) {
      const double position = (p[k] - lower[k]) / voxel_size_ - 0.5;
      // What is not a number stands at 0.
      const double inside = std::min(std::max(0.0, position), static_cast<double>(shape_[k] - 1));
      cell[k] = std::min(static_cast<int64_t>(inside), shape_[k] - 2);
      f[k] = inside - static_cast<double>(cell[k]);
    }
    const int64_t row = shape_[2], layer = shape_[1] * shape_[2];
    const float* near = times_ + cell[0] * layer + cell[1] * row + cell[2];
    const float* far = near + layer;
    float step[2][2];    // by y and z
    double along[2][2];  // interpolated along x
    for (int j = 0; j < 2; ++j) {
      for (int k = 0; k < 2; ++k) {
        const int64_t at = j * row + k;
        step[j][k] = far[at] - near[at];
        along[j][k] = near[at] + f[0] * step[j][k];
      }
    }
    double along_x[2], along_y[2];  // slopes, by z
    for (int k = 0; k < 2; ++k) {
      along_x[k] = step[0][k] + f[1] * (step[1][k] - step[0][k]);
      along_y[k] = along[1][k] - along[0][k];
    }
    const double along_z = (along[0][1] + f[1] * along_y[1]) - (along[0][0] + f[1] * along_y[0]);
    const Vector slope = {along_x[0] + f[2] * (along_x[1] - along_x[0]),
                          along_y[0] + f[2] * (along_y[1] - along_y[0]), along_z};
    return slope / voxel_size_;
  }

 private:
  const float* times_;
  int64_t shape_[3];
  Vector lower_W_;
  double voxel_size_;
};

size_t descend(const Times& times, const Point& lower_W, double voxel_size, const Point& p_WG,
               const Point& p_WQ, double step, double length, const WayPoints& way) {
  require(voxel_size > 0.0 && step > 0.0, "voxels and steps need a size");
  const TimeGrid grid(times, vector(lower_W), voxel_size);
  const Vector goal = vector(p_WG);
  Vector p = vector(p_WQ), direction = {0.0, 0.0, 0.0};
  double covered = 0.0;
  for (size_t count = 0; count < way.shape(0); ++count) {
    const double row[4] = {p.x, p.y, p.z, covered};
    std::copy_n(row, 4, way.data() + 4 * count);
    const Vector to_goal = goal - p;
    const double distance = to_goal.length();
    if (!(covered < length) || distance < 1e-9) return count + 1;
    // The mean with the last direction: plain steepest descent zigzags in a valley.
    direction =
        distance < 2.0 * step ? to_goal / distance : (direction - grid.gradient(p).unit()).unit();
    const double stride = std::min(step, distance);
    p = {p.x + stride * direction.x, p.y + stride * direction.y, p.z + stride * direction.z};
    covered += stride;
  }
  return way.shape(0);
}

}  // namespace

void bind_descent(nb::module_& m) {
  m.def("descend", &descend, nb::kw_only(), "times"_a, "lower_W"_a, "voxel_size"_a, "p_WG"_a,
        "p_WQ"_a, "step"_a, "length"_a, "way"_a,
        "Writes points and the length up to them, rows (4,), down the gradient of `times` from\n"
        "p_WQ to p_WG or until `length` is covered; returns how many.");
}

}  // namespace splatpilot
