// Python binding of distances between the voxels of a grid, in double precision: operation by
// operation what `splatpilot.systems.collision.esdf.Esdf.query` computes, so that both have the
// same bits.
#include <limits>

#include "bindings/bindings.hpp"

namespace splatpilot {
namespace {

using namespace nb::literals;
using Grid = Floats<nb::ndim<3>>;
using Corner = Doubles<nb::shape<3>>;
using QueryPoints = Doubles<nb::shape<-1, 3>>;
using Distances = nb::ndarray<double, nb::ndim<1>, nb::c_contig, nb::device::cpu>;

double mix(double a, double b, double part) { return a + part * (b - a); }

void grid_distances(const Grid& grid, const Corner& lower_W, const Corner& upper_W,
                    double voxel_size, bool occupied_outside, const QueryPoints& p_WQ,
                    const Distances& distances) {
  const size_t count = p_WQ.shape(0);
  require(distances.size() == count, "points and distances differ in number");
  require(voxel_size > 0.0, "voxels need a size");
  int64_t last[3];
  double first[3];  // centre of the first voxel
  for (int k = 0; k < 3; ++k) {
    last[k] = static_cast<int64_t>(grid.shape(k)) - 2;
    require(last[k] >= 0, "a grid needs at least 2 voxels along each axis");
    first[k] = lower_W.data()[k] + 0.5 * voxel_size;
  }
  const int64_t row = last[2] + 2, layer = row * (last[1] + 2);
  const double *lower = lower_W.data(), *upper = upper_W.data();
  for (size_t i = 0; i < count; ++i) {
    const double* p = p_WQ.data() + 3 * i;
    double f[3], beyond[3];
    int64_t at = 0;
    bool inside = true;
    for (int k = 0; k < 3; ++k) {
      // What is not a number stays so in the fraction, and stands in the first cell.
      const double in_box = p[k] < lower[k] ? lower[k] : p[k] > upper[k] ? upper[k] : p[k];
      const double position = (in_box - first[k]) / voxel_size;
      const int64_t cell = position > 0.0 ? std::min(static_cast<int64_t>(position), last[k]) : 0;
      f[k] = position - static_cast<double>(cell);
      beyond[k] = p[k] - in_box;
      inside = inside && p[k] == in_box;
      at += cell * (k == 0 ? layer : k == 1 ? row : 1);
    }
    if (!inside && !occupied_outside) {
      distances.data()[i] = std::numeric_limits<double>::quiet_NaN();
      continue;
    }
    const float *near = grid.data() + at, *far = near + layer;
    const double low_y = mix(mix(near[0], far[0], f[0]), mix(near[row], far[row], f[0]), f[1]);
    const double high_y =
        mix(mix(near[1], far[1], f[0]), mix(near[row + 1], far[row + 1], f[0]), f[1]);
    double distance = mix(low_y, high_y, f[2]);
    if (!inside) {
      distance -= std::sqrt(beyond[0] * beyond[0] + beyond[1] * beyond[1] + beyond[2] * beyond[2]);
    }
    distances.data()[i] = distance;
  }
}

}  // namespace

void bind_grid_field(nb::module_& m) {
  m.def("grid_distances", &grid_distances, nb::kw_only(), "grid"_a, "lower_W"_a, "upper_W"_a,
        "voxel_size"_a, "occupied_outside"_a, "p_WQ"_a, "distances"_a,
        "Writes the distances (N,) at N points: between the centres of voxels, those of the grid\n"
        "interpolated trilinearly; outside, minus the way to the box, or NaN.");
}

}  // namespace splatpilot
