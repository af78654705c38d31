// Python bindings of worlds of regular grids.
#include "bindings/casting_bindings.hpp"

namespace splatpilot {
namespace {

using namespace nb::literals;
using GridShapes = nb::ndarray<const int64_t, nb::shape<-1, 3>, nb::c_contig, nb::device::cpu>;

class GridWorlds : Casting {
 public:
  GridWorlds(const Floats<nb::ndim<1>>& values, const GridShapes& shapes, const Points& lower_W,
             const Floats<nb::ndim<1>>& voxel_sizes, int threads, const std::string& simd)
      : Casting(threads, simd), values_(values.data(), values.data() + values.size()) {
    const size_t count = shapes.shape(0);
    require(lower_W.shape(0) == count && voxel_sizes.size() == count,
            "shapes, lower corners and voxel sizes of grids differ in number");
    size_t begin = 0;
    for (size_t w = 0; w < count; ++w) {
      GridWorld grid{};
      size_t size = 1;
      grid.voxel_size = voxel_sizes.data()[w];
      require(grid.voxel_size > 0.0f && std::isfinite(grid.voxel_size),
              "a voxel's size must be positive");
      for (int k = 0; k < 3; ++k) {
        const int64_t length = shapes.data()[3 * w + k];
        require(length >= 2 && length <= 32768, "a grid needs 2 to 32768 voxels along each axis");
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

  void depth(const Points& p, const Rotations& R, const Numbers& world, const Points& directions,
             float half_pixel, const DepthRows& depth) {
    for_each_camera(p, R, world, size(), directions, half_pixel, depth, 0,
                    [this](size_t w, auto&&... rest) { kernels_.cast_grid(grids_[w], rest...); });
  }

  void interpolate(const Points& p, const Numbers& world, const Writable<nb::ndim<1>>& values,
                   const Rows3& gradients) {
    const size_t n = p.shape(0);
    require(values.size() == n && gradients.shape(0) == n,
            "points, values and gradients differ in number");
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

}  // namespace

void bind_grid_worlds(nb::module_& m) {
  nb::class_<GridWorlds>(m, "GridWorlds", "Regular grids of several worlds, one of each.")
      .def(nb::init<const Floats<nb::ndim<1>>&, const GridShapes&, const Points&,
                    const Floats<nb::ndim<1>>&, int, const std::string&>(),
           nb::kw_only(), "values"_a, "shapes"_a, "lower_W"_a, "voxel_sizes"_a, "threads"_a = 1,
           "simd"_a = "", "The values of all grids, one after another.")
      .def("__len__", &GridWorlds::size)
      .def("depth", &GridWorlds::depth, nb::kw_only(), "p_WC"_a, "R_WC"_a, "world"_a,
           "directions_C"_a, "half_pixel"_a, "depth"_a,
           "Writes the depth images of N cameras where the values are signed distances.")
      .def("interpolate", &GridWorlds::interpolate, nb::kw_only(), "p_WQ"_a, "world"_a, "values"_a,
           "gradients"_a, "Writes the trilinear interpolants (N,) and their gradients (N, 3).");
}

}  // namespace splatpilot
