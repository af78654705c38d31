// Python binding of paths down a time of arrival, in double precision: see
// `splatpilot.systems.policies.time_of_arrival`.
#include "bindings/bindings.hpp"
#include "fields/grid_interpolation.hpp"

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

// The gradient at a point brought between the outermost voxel centers.
Vector gradient(const VoxelGrid& grid, const Vector& p_WQ) {
  double p[3] = {p_WQ.x, p_WQ.y, p_WQ.z};
  for (int k = 0; k < 3; ++k) {
    const double first = grid.lower_W[k] + 0.5 * grid.voxel_size;
    const double last = first + static_cast<double>(grid.shape[k] - 1) * grid.voxel_size;
    p[k] = std::min(std::max(first, p[k]), last);  // NaN becomes `first`
  }
  const Interpolant at = grid.interpolate(p, true);
  return {at.gradient[0], at.gradient[1], at.gradient[2]};
}

size_t descend(const Times& times, const Point& lower_W, double voxel_size, const Point& p_WG,
               const Point& p_WQ, double step, double length, const WayPoints& way) {
  require(voxel_size > 0.0 && step > 0.0, "voxels and steps need a size");
  VoxelGrid grid{times.data(), {}, {}, voxel_size};
  for (int k = 0; k < 3; ++k) {
    grid.shape[k] = static_cast<int64_t>(times.shape(k));
    require(grid.shape[k] >= 2, "a grid needs at least 2 voxels along each axis");
    grid.lower_W[k] = lower_W.data()[k];
  }
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
        distance < 2.0 * step ? to_goal / distance : (direction - gradient(grid, p).unit()).unit();
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
