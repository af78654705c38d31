// Python bindings of worlds of regular grids, and of distances in and descent along one grid.
#include <nanobind/stl/optional.h>

#include <optional>

#include "bindings/casting_bindings.hpp"
#include "fields/fast_marching.hpp"
#include "fields/grid_distance.hpp"

#define SIMD_LEVEL baseline
#include "core/vectors.hpp"

namespace splatpilot {
namespace {

using Volume = Doubles<nb::ndim<3>>;
using PathRows = Written<double, nb::shape<-1, 4>>;
using GridShapes = Array<const int64_t, nb::shape<-1, 3>>;
using Vector = SIMD_LEVEL::Vector3<double>;

class GridWorlds : Casting {
 public:
  GridWorlds(const Values& values, const GridShapes& shapes, const Points& lower_W,
             const Values& voxel_sizes, int threads, const std::string& simd)
      : Casting(threads, simd), values_(values.data(), values.data() + values.size()) {
    const size_t count = shapes.shape(0);
    require_rows(count, "shapes, lower corners and voxel sizes of grids differ in number", lower_W,
                 voxel_sizes);
    size_t begin = 0;
    for (size_t w = 0; w < count; ++w) {
      GridWorld grid{};
      size_t size = 1;
      grid.voxel_size = voxel_sizes.data()[w];
      require(grid.voxel_size > 0.0f && std::isfinite(grid.voxel_size),
              "voxel sizes must be finite and > 0");
      for (int k = 0; k < 3; ++k) {
        const int64_t length = shapes.data()[3 * w + k];
        require(length >= 2 && length <= 32768, "a grid has 2 to 32768 voxels along each axis");
        grid.shape[k] = static_cast<int32_t>(length);
        grid.first_center[k] = lower_W.data()[3 * w + k] + 0.5f * grid.voxel_size;
        require(std::isfinite(grid.first_center[k]), "a grid's lower corner must be finite");
        size *= static_cast<size_t>(length);
      }
      require(size <= 0x7fffffff, "a grid has more than 2^31 - 1 voxels");
      require(size <= values_.size() - begin, "there are fewer values than voxels");
      grid.values = values_.data() + begin;
      begin += size;
      grids_.push_back(grid);
    }
    require(begin == values_.size(), "there are more values than voxels");
  }

  size_t size() const { return grids_.size(); }

  void depth(const Points& p, const Rotations& R, const Indices& world, const Points& directions,
             float half_pixel, const DepthRows& depth) {
    for_each_camera(p, R, world, size(), directions, half_pixel, depth, 0,
                    [this](size_t w, auto&&... rest) { kernels_.cast_grid(grids_[w], rest...); });
  }

  void interpolate(const Points& p, const Indices& world, const ValuesOut& values,
                   const Rows3Out& gradients) {
    const size_t n = p.shape(0);
    require_rows(n, "points, values and gradients differ in number", values, gradients);
    require_worlds(world, n, size());
    const nb::gil_scoped_release release;
    for (size_t i = 0; i < n; ++i) {
      values.data()[i] = kernels_.interpolate(grids_[static_cast<size_t>(world.data()[i])],
                                              p.data() + 3 * i, gradients.data() + 3 * i);
    }
  }

 private:
  std::vector<float> values_;
  std::vector<GridWorld> grids_;
};

void grid_distances(const Grid& grid, const Point& lower_W, const Point& upper_W, double voxel_size,
                    bool occupied_outside, const QueryPoints& p_WQ, const Distances& distances,
                    const std::optional<Gradients>& gradients) {
  const size_t count = p_WQ.shape(0);
  require(distances.size() == count && (!gradients || gradients->shape(0) == count),
          "points, distances and gradients differ in number");
  GridField field{voxel_grid(grid, lower_W, voxel_size), {}, occupied_outside};
  std::copy_n(upper_W.data(), 3, field.upper_W);
  for (size_t i = 0; i < count; ++i) {
    double* gradient = gradients ? gradients->data() + 3 * i : nullptr;
    distances.data()[i] = field.distance(p_WQ.data() + 3 * i, gradient);
  }
}

void travel_times(const Volume& front, const Volume& speed,
                  const Array<const bool, nb::ndim<3>>& blocked, double voxel_size,
                  const Written<double, nb::ndim<3>>& times) {
  int64_t shape[3];
  for (size_t k = 0; k < 3; ++k) {
    shape[k] = static_cast<int64_t>(front.shape(k));
    require(speed.shape(k) == front.shape(k) && blocked.shape(k) == front.shape(k) &&
                times.shape(k) == front.shape(k),
            "front, speeds, blocked cells and times differ in shape");
  }
  const nb::gil_scoped_release release;
  FastMarching(shape, voxel_size, front.data(), speed.data(), blocked.data(), times.data()).march();
}

double length(const Vector& a) { return std::sqrt(dot(a, a)); }
Vector divided(const Vector& a, double s) { return {a.x / s, a.y / s, a.z / s}; }
// Zero stays zero.
Vector unit(const Vector& a) { return length(a) > 0.0 ? divided(a, length(a)) : a; }
Vector vector(const Point& p) { return {p.data()[0], p.data()[1], p.data()[2]}; }

// The gradient at a point clamped to the outermost voxel centers.
Vector gradient(const VoxelGrid& grid, const Vector& p_WQ) {
  double p[3] = {p_WQ.x, p_WQ.y, p_WQ.z};
  for (int k = 0; k < 3; ++k) {
    const double first = grid.lower_W[k] + 0.5 * grid.voxel_size;
    const double last = first + static_cast<double>(grid.shape[k] - 1) * grid.voxel_size;
    p[k] = std::min(std::max(first, p[k]), last);  // NaN becomes `first`
  }
  const Interpolant at = grid.interpolate(p);
  return {at.gradient[0], at.gradient[1], at.gradient[2]};
}

size_t descend(const Grid& times, const Point& lower_W, double voxel_size, const Point& p_WG,
               const Point& p_WQ, double step, double max_length, const PathRows& path) {
  require(step > 0.0, "step must be > 0");
  const VoxelGrid grid = voxel_grid(times, lower_W, voxel_size);
  const Vector goal = vector(p_WG);
  Vector p = vector(p_WQ), direction = {0.0, 0.0, 0.0};
  double covered = 0.0;
  for (size_t count = 0; count < path.shape(0); ++count) {
    const double row[4] = {p.x, p.y, p.z, covered};
    std::copy_n(row, 4, path.data() + 4 * count);
    const Vector to_goal = goal - p;
    const double distance = length(to_goal);
    if (!(covered < max_length) || distance < 1e-9) return count + 1;
    // The mean with the last direction: plain steepest descent zigzags in a valley.
    direction = distance < 2.0 * step ? divided(to_goal, distance)
                                      : unit(direction - unit(gradient(grid, p)));
    const double stride = std::min(step, distance);
    p = p + stride * direction;
    covered += stride;
  }
  return path.shape(0);
}

}  // namespace

void bind_grids(nb::module_& m) {
  nb::class_<GridWorlds>(m, "GridWorlds", "Regular grids, one per world.")
      .def(nb::init<const Values&, const GridShapes&, const Points&, const Values&, int,
                    const std::string&>(),
           nb::kw_only(), "values"_a, "shapes"_a, "lower_W"_a, "voxel_sizes"_a, "threads"_a = 1,
           "simd"_a = "", "The values of all grids, one after another.")
      .def("__len__", &GridWorlds::size)
      .def("depth", &GridWorlds::depth, nb::kw_only(), "p_WC"_a, "R_WC"_a, "world"_a,
           "directions_C"_a, "half_pixel"_a, "depth"_a,
           "Writes the depth images of N cameras where the values are signed distances.")
      .def("interpolate", &GridWorlds::interpolate, nb::kw_only(), "p_WQ"_a, "world"_a, "values"_a,
           "gradients"_a, "Writes the trilinear interpolants (N,) and their gradients (N, 3).");
  m.def("grid_distances", &grid_distances, nb::kw_only(), "grid"_a, "lower_W"_a, "upper_W"_a,
        "voxel_size"_a, "occupied_outside"_a, "p_WQ"_a, "distances"_a, "gradients"_a = nb::none(),
        "Writes the distances (N,) at N points and their gradients (N, 3): between the centers of\n"
        "voxels the trilinear interpolant of the grid; outside, minus the distance to the box, or\n"
        "NaN with a gradient of zero.");
  m.def(
      "travel_times", &travel_times, nb::kw_only(), "front"_a, "speed"_a, "blocked"_a,
      "voxel_size"_a, "times"_a,
      "Writes the times at which a front from the zeros of the distances `front` arrives at each\n"
      "voxel, at most at `speed` and around blocked voxels; infinity where it does not arrive.");
  m.def("descend", &descend, nb::kw_only(), "times"_a, "lower_W"_a, "voxel_size"_a, "p_WG"_a,
        "p_WQ"_a, "step"_a, "length"_a, "path"_a,
        "Writes points and the length up to them, rows (4,), down the gradient of `times` from\n"
        "p_WQ to p_WG or until `length` is covered; returns their number.");
}

}  // namespace splatpilot
