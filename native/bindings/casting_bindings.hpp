// Types that the Python bindings of worlds for ray casting share.
#pragma once

#include <nanobind/stl/string.h>

#include <numeric>
#include <string>
#include <vector>

#include "bindings/bindings.hpp"
#include "casting/ray_casting.hpp"
#include "core/dispatch.hpp"
#include "core/thread_pool.hpp"
#include "fields/grid_interpolation.hpp"

namespace splatpilot {

using Points = Rows3;
using Rotations = Floats<nb::shape<-1, 3, 3>>;
using DepthRows = Writable<nb::ndim<2>>;
using QueryPoints = Doubles<nb::shape<-1, 3>>;
using Distances = Written<double, nb::ndim<1>>;
using Gradients = Written<double, nb::shape<-1, 3>>;
using Grid = Floats<nb::ndim<3>>;
using Point = Doubles<nb::shape<3>>;

constexpr size_t kPack = 16;
constexpr size_t kCameras = 4;  // to a task

inline void require_worlds(const Indices& world, size_t queries, size_t worlds) {
  require_rows(queries, "worlds and points differ in number", world);
  for (size_t n = 0; n < queries; ++n) {
    const int64_t w = world.data()[n];
    if (w < 0 || static_cast<size_t>(w) >= worlds) {
      throw std::invalid_argument("world must be in [0, " + std::to_string(worlds) + "), got " +
                                  std::to_string(w));
    }
  }
}

inline VoxelGrid voxel_grid(const Grid& values, const Point& lower_W, double voxel_size) {
  require(voxel_size > 0.0, "voxel_size must be > 0");
  VoxelGrid grid{values.data(), {}, {}, voxel_size};
  for (int k = 0; k < 3; ++k) {
    grid.shape[k] = static_cast<int64_t>(values.shape(k));
    require(grid.shape[k] >= 2, "a grid has at least 2 voxels along each axis");
    grid.lower_W[k] = lower_W.data()[k];
  }
  return grid;
}

// The rays of a camera, in whole packs.
struct OwnRays {
  std::vector<float> xy;
  std::vector<uint32_t> pixels;
  PixelRays rays{};

  OwnRays(const Points& directions, float half_pixel) {
    const size_t count = directions.shape(0), size = (count + kPack - 1) / kPack * kPack;
    require(count > 0 && count <= 0xffffffff / 3, "a camera has no pixels, or too many");
    require(half_pixel >= 0.0f, "half_pixel must be >= 0");
    const auto direction = [&](uint32_t pixel) { return directions.data() + 3 * pixel; };
    for (uint32_t pixel = 0; pixel < count; ++pixel) {
      const float* d = direction(pixel);
      require(std::isfinite(d[0]) && std::isfinite(d[1]) && d[2] == 1.0f,
              "rays must be finite and have depth 1 in the camera's frame");
    }
    pixels.resize(count);
    std::iota(pixels.begin(), pixels.end(), 0u);
    std::stable_sort(pixels.begin(), pixels.end(),
                     [&](uint32_t a, uint32_t b) { return direction(a)[0] < direction(b)[0]; });
    xy.resize(2 * size);
    for (size_t i = 0; i < size; ++i) {
      const float* d = direction(pixels[std::min(i, count - 1)]);
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

// The kernels and threads of worlds, for one caller at a time.
class Casting {
 public:
  Casting(int threads, const std::string& simd)
      : kernels_(*kernels(simd).casting), pool_(checked_threads(threads)) {}

 protected:
  // Calls cast(camera, world, rays, pose, scratch, depth) for each camera.
  template <typename Cast>
  void for_each_camera(const Points& p, const Rotations& R, const Indices& world, size_t worlds,
                       const Points& directions, float half_pixel, const DepthRows& depth,
                       size_t max_bodies, const Cast& cast) {
    const size_t count = p.shape(0);
    require(R.shape(0) == count && depth.shape(0) == count && depth.shape(1) == directions.shape(0),
            "positions, rotations and images of cameras differ in shape");
    require_worlds(world, count, worlds);
    const OwnRays own(directions, half_pixel);
    const nb::gil_scoped_release release;
    const std::scoped_lock lock(mutex_);
    const size_t size = kernels_.scratch(own.rays.count, max_bodies);
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
  ThreadPool pool_;
  std::mutex mutex_;
};

}  // namespace splatpilot
