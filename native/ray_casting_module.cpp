// Python bindings of worlds that rays are cast in.
#include <nanobind/stl/string.h>

#include <numeric>
#include <string>
#include <vector>

#include "bindings.hpp"
#include "dispatch.hpp"
#include "ray_casting.hpp"
#include "thread_pool.hpp"

namespace splatpilot {
namespace {

using namespace nb::literals;
using Rows = Floats<nb::shape<-1, kShapeSize>>;
using Points = Floats<nb::shape<-1, 3>>;
using Rotations = Floats<nb::shape<-1, 3, 3>>;
using Kinds = nb::ndarray<const uint8_t, nb::ndim<1>, nb::c_contig, nb::device::cpu>;
using Numbers = nb::ndarray<const int64_t, nb::ndim<1>, nb::c_contig, nb::device::cpu>;
using GridShapes = nb::ndarray<const int64_t, nb::shape<-1, 3>, nb::c_contig, nb::device::cpu>;
using DepthRows = Writable<nb::ndim<2>>;

constexpr size_t kPack = 16;
constexpr size_t kCameras = 4;  // to a task

void require_worlds(const Numbers& world, size_t queries, size_t worlds) {
  require(world.size() == queries, "the numbers of worlds differ in length from the points");
  for (size_t n = 0; n < queries; ++n) {
    const int64_t w = world.data()[n];
    if (w < 0 || static_cast<size_t>(w) >= worlds) {
      throw std::invalid_argument("world " + std::to_string(w) + " of " + std::to_string(worlds) +
                                  " worlds, which count from 0");
    }
  }
}

// The rays of a camera, in whole packs.
struct OwnRays {
  std::vector<float> xy;
  std::vector<uint32_t> pixels;
  PixelRays rays{};

  OwnRays(const Points& directions, float half_pixel) {
    const size_t count = directions.shape(0), size = (count + kPack - 1) / kPack * kPack;
    require(count > 0 && count <= 0xffffffff / 3, "the camera has no pixels, or too many");
    require(half_pixel >= 0.0f, "the width of a pixel must not be negative");
    const auto direction = [&](uint32_t pixel) { return directions.data() + 3 * pixel; };
    pixels.resize(count);
    std::iota(pixels.begin(), pixels.end(), 0u);
    std::stable_sort(pixels.begin(), pixels.end(),
                     [&](uint32_t a, uint32_t b) { return direction(a)[0] < direction(b)[0]; });
    xy.resize(2 * size);
    for (size_t i = 0; i < size; ++i) {
      const float* d = direction(pixels[std::min(i, count - 1)]);
      require(d[2] == 1.0f, "rays must have depth 1 in the camera's frame");
      xy[i] = d[0];
      xy[size + i] = d[1];
    }
    rays.x = xy.data();
    rays.y = xy.data() + size;
    rays.pixels = pixels.data();
    rays.count = count;
    rays.half_pixel = half_pixel;
    for (int k = 0; k < 2; ++k) {
      const auto [low, high] =
          std::minmax_element(xy.begin() + k * size, xy.begin() + (k + 1) * size);
      rays.low[k] = *low;
      rays.high[k] = *high;
    }
  }
};

// What worlds of both kinds have: kernels, and threads that one caller uses at a time.
class Casting {
 public:
  Casting(int threads, const std::string& simd)
      : kernels_(*kernels(simd).casting), pool_(checked(threads)) {}

 protected:
  // Calls cast(camera, world, rays, pose, scratch, depth) for each camera.
  template <typename Cast>
  void for_each_camera(const Points& p, const Rotations& R, const Numbers& world, size_t worlds,
                       const Points& directions, float half_pixel, const DepthRows& depth,
                       size_t most_bodies, const Cast& cast) {
    const size_t count = p.shape(0);
    require(R.shape(0) == count && depth.shape(0) == count && depth.shape(1) == directions.shape(0),
            "positions, rotations and images of cameras differ in shape");
    require_worlds(world, count, worlds);
    const OwnRays own(directions, half_pixel);
    const nb::gil_scoped_release release;
    const std::scoped_lock lock(mutex_);
    const size_t size = kernels_.scratch(own.rays.count, most_bodies);
    pool_.for_each((count + kCameras - 1) / kCameras, [&](size_t task) {
      thread_local std::vector<float> scratch;
      if (scratch.size() < size) scratch.resize(size);
      for (size_t n = task * kCameras; n < std::min(count, (task + 1) * kCameras); ++n) {
        CameraPose pose;
        std::copy_n(p.data() + 3 * n, 3, pose.p);
        std::copy_n(R.data() + 9 * n, 9, pose.R);
        cast(static_cast<size_t>(world.data()[n]), own.rays, pose, scratch.data(),
             depth.data() + n * own.rays.count);
      }
    });
  }

  const CastingKernels& kernels_;

 private:
  static int checked(int threads) {
    require(threads >= 1 && threads <= 1024, "threads must lie between 1 and 1024");
    return threads;
  }

  ThreadPool pool_;
  std::mutex mutex_;
};

// Centre and half size along each axis of what encloses a body, a little more than needed.
void bound(uint8_t kind, const float* s, float* center, float* half) {
  for (int k = 0; k < 3; ++k) {
    const float axis = s[3 + k];
    center[k] = s[k];
    if (kind == kSphere) half[k] = s[3];
    if (kind == kCapsule) {
      center[k] += 0.5f * s[6] * axis;
      half[k] = 0.5f * s[6] * std::abs(axis) + s[7];
    }
    if (kind == kCylinder) {
      half[k] = s[6] * std::abs(axis) + s[7] * std::sqrt(std::max(0.0f, 1.0f - axis * axis));
    }
    if (kind == kBox) {
      half[k] = 0.0f;
      for (int j = 0; j < 3; ++j) half[k] += std::abs(s[3 + 3 * k + j]) * s[12 + j];
    }
    half[k] += 1e-6f * (half[k] + std::abs(center[k]));
  }
}

class ShapeWorlds : Casting {
 public:
  ShapeWorlds(const Rows& shapes, const Kinds& kinds, const Numbers& first, int threads,
              const std::string& simd)
      : Casting(threads, simd) {
    const size_t count = shapes.shape(0);
    require(kinds.size() == count, "the kinds of shapes differ in number from the shapes");
    require(first.size() > 0 && first.data()[0] == 0 &&
                first.data()[first.size() - 1] == static_cast<int64_t>(count),
            "the first shapes of worlds must begin with 0 and end with the number of shapes");
    for (size_t w = 0; w + 1 < first.size(); ++w) {
      const int64_t begin = first.data()[w], end = first.data()[w + 1];
      require(begin <= end && end <= static_cast<int64_t>(count),
              "the first shapes of worlds must ascend");
      add_world(shapes, kinds, static_cast<size_t>(begin), static_cast<size_t>(end));
    }
  }

  size_t size() const { return worlds_.size(); }

  void depth(const Points& p, const Rotations& R, const Numbers& world, const Points& directions,
             float half_pixel, const DepthRows& depth) {
    for_each_camera(p, R, world, size(), directions, half_pixel, depth, most_bodies_,
                    [this](size_t w, auto&&... rest) { kernels_.cast_shapes(view(w), rest...); });
  }

  void nearest(const Points& p, const Numbers& world, const DepthRows& distances,
               const Output& gradients) {
    const size_t n = p.shape(0), count = distances.shape(1);
    require(distances.shape(0) == n && gradients.shape(0) == n && gradients.shape(1) == count &&
                gradients.shape(2) == 3,
            "points, distances and gradients differ in shape");
    require(count >= 1 && count <= kMostNearest, "1 to 16 nearest shapes can be asked for");
    require_worlds(world, n, size());
    const nb::gil_scoped_release release;
    for (size_t i = 0; i < n; ++i) {
      kernels_.nearest_shapes(view(static_cast<size_t>(world.data()[i])), p.data() + 3 * i, count,
                              distances.data() + i * count, gradients.data() + 3 * i * count);
    }
  }

 private:
  struct Range {
    size_t body, body_count, half_space, half_space_count, bounds, stride;
  };

  void add_world(const Rows& shapes, const Kinds& kinds, size_t begin, size_t end) {
    Range r{kinds_.size(), 0, half_spaces_.size() / kShapeSize, 0, bounds_.size(), 0};
    for (size_t i = begin; i < end; ++i) {
      const float* s = shapes.data() + i * kShapeSize;
      const uint8_t kind = kinds.data()[i];
      require(kind < kShapeKinds, "a shape is of no known kind");
      require(std::all_of(s, s + kShapeSize, [](float x) { return std::isfinite(x); }),
              "the numbers of a shape must be finite");
      std::vector<float>& rows = kind == kHalfSpace ? half_spaces_ : bodies_;
      rows.insert(rows.end(), s, s + kShapeSize);
      if (kind == kHalfSpace) {
        ++r.half_space_count;
      } else {
        kinds_.push_back(kind);
        ++r.body_count;
      }
    }
    r.stride = (r.body_count + kPack - 1) / kPack * kPack;
    bounds_.resize(r.bounds + 6 * r.stride);
    for (size_t i = 0; i < r.body_count; ++i) {
      float center[3], half[3];
      bound(kinds_[r.body + i], bodies_.data() + (r.body + i) * kShapeSize, center, half);
      for (size_t k = 0; k < 3; ++k) {
        bounds_[r.bounds + k * r.stride + i] = center[k];
        bounds_[r.bounds + (k + 3) * r.stride + i] = half[k];
      }
    }
    most_bodies_ = std::max(most_bodies_, r.body_count);
    worlds_.push_back(r);
  }

  ShapeWorld view(size_t w) const {
    const Range& r = worlds_[w];
    return {bodies_.data() + r.body * kShapeSize,
            kinds_.data() + r.body,
            r.body_count,
            bounds_.data() + r.bounds,
            r.stride,
            half_spaces_.data() + r.half_space * kShapeSize,
            r.half_space_count};
  }

  std::vector<float> bodies_, half_spaces_, bounds_;
  std::vector<uint8_t> kinds_;
  std::vector<Range> worlds_;
  size_t most_bodies_ = 0;
};

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

void bind_ray_casting(nb::module_& m) {
  nb::class_<ShapeWorlds>(m, "ShapeWorlds", "The analytic shapes of several worlds.")
      .def(nb::init<const Rows&, const Kinds&, const Numbers&, int, const std::string&>(),
           nb::kw_only(), "shapes"_a, "kinds"_a, "first"_a, "threads"_a = 1, "simd"_a = "",
           "World w has the rows first[w] to first[w + 1]. A row holds, by its kind: 0 centre and\n"
           "radius of a sphere; 1 end, axis, length and radius of a capsule; 2 centre, axis, half\n"
           "length and radius of a cylinder; 3 centre, rotation and half sizes of a box; 4 normal\n"
           "and offset of a half space.")
      .def("__len__", &ShapeWorlds::size)
      .def("depth", &ShapeWorlds::depth, nb::kw_only(), "p_WC"_a, "R_WC"_a, "world"_a,
           "directions_C"_a, "half_pixel"_a, "depth"_a, "Writes the depth images of N cameras.")
      .def("nearest", &ShapeWorlds::nearest, nb::kw_only(), "p_WQ"_a, "world"_a, "distances"_a,
           "gradients"_a,
           "Writes the distances (N, K) of the K nearest shapes and their gradients (N, K, 3).");
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
