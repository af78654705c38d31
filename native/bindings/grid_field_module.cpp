// Python binding of signed distances between the voxel centers of a grid, in double precision.
#include <nanobind/stl/optional.h>

#include <limits>
#include <optional>

#include "bindings/bindings.hpp"
#include "fields/grid_interpolation.hpp"

namespace splatpilot {
namespace {

using namespace nb::literals;
using Grid = Floats<nb::ndim<3>>;
using Corner = Doubles<nb::shape<3>>;
using QueryPoints = Doubles<nb::shape<-1, 3>>;
using Distances = nb::ndarray<double, nb::ndim<1>, nb::c_contig, nb::device::cpu>;
using Gradients = nb::ndarray<double, nb::shape<-1, 3>, nb::c_contig, nb::device::cpu>;

void grid_distances(const Grid& grid, const Corner& lower_W, const Corner& upper_W,
                    double voxel_size, bool occupied_outside, const QueryPoints& p_WQ,
                    const Distances& distances, const std::optional<Gradients>& gradients) {
  const size_t count = p_WQ.shape(0);
  require(distances.size() == count && (!gradients || gradients->shape(0) == count),
          "points, distances and gradients differ in number");
  require(voxel_size > 0.0, "voxels need a size");
  VoxelGrid voxels{grid.data(), {}, {}, voxel_size};
  for (int k = 0; k < 3; ++k) {
    voxels.shape[k] = static_cast<int64_t>(grid.shape(k));
    require(voxels.shape[k] >= 2, "a grid needs at least 2 voxels along each axis");
    voxels.lower_W[k] = lower_W.data()[k];
  }
  const double *lower = lower_W.data(), *upper = upper_W.data();
  for (size_t i = 0; i < count; ++i) {
    const double* p = p_WQ.data() + 3 * i;
    double in_box[3], beyond[3];
    bool inside = true;
    for (int k = 0; k < 3; ++k) {
      in_box[k] = p[k] < lower[k] ? lower[k] : p[k] > upper[k] ? upper[k] : p[k];
      beyond[k] = p[k] - in_box[k];
      inside = inside && p[k] == in_box[k];  // false also for NaN
    }
    double* gradient = gradients ? gradients->data() + 3 * i : nullptr;
    if (!inside && !occupied_outside) {
      distances.data()[i] = std::numeric_limits<double>::quiet_NaN();
      if (gradient) std::fill_n(gradient, 3, 0.0);
      continue;
    }
    Interpolant at = voxels.interpolate(in_box, gradient != nullptr);
    if (!inside) {
      const double away =
          std::sqrt(beyond[0] * beyond[0] + beyond[1] * beyond[1] + beyond[2] * beyond[2]);
      at.value -= away;
      for (int k = 0; k < 3; ++k) {
        at.gradient[k] = (beyond[k] == 0.0 ? at.gradient[k] : 0.0) - beyond[k] / away;
      }
    }
    distances.data()[i] = at.value;
    if (gradient) std::copy_n(at.gradient, 3, gradient);
  }
}

}  // namespace

void bind_grid_field(nb::module_& m) {
  m.def("grid_distances", &grid_distances, nb::kw_only(), "grid"_a, "lower_W"_a, "upper_W"_a,
        "voxel_size"_a, "occupied_outside"_a, "p_WQ"_a, "distances"_a, "gradients"_a = nb::none(),
        "Writes the distances (N,) at N points and their gradients (N, 3): between the centers of\n"
        "voxels the trilinear interpolant of the grid; outside, minus the distance to the box, or\n"
        "NaN with a gradient of zero.");
}

}  // namespace splatpilot
