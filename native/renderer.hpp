// One frame: project, sort by depth, bin into tiles, composite.
#pragma once

#include <functional>
#include <mutex>
#include <string>
#include <vector>

#include "radix_sort.hpp"
#include "thread_pool.hpp"
#include "types.hpp"

namespace flysplat {

struct CameraParameters {
  int width, height;
  double K[9];                      // row-major, [px]; skew is ignored
  double X_CW[16];                  // world to camera, row-major
  double near_plane, far_plane;     // [m]
  double radius_clip, eps2d;        // [px], [px^2]
};

Camera make_camera(const CameraParameters& parameters);

// Holds the scratch memory of a frame and the threads; memory is reused by the next frame and never
// influences it. After a frame the splats, their order and the tile lists remain readable: that is
// what a backward pass starts from. Not for use by two threads at a time: hold mutex().
class Renderer {
 public:
  Renderer(int threads, const std::string& simd_level);

  void render(const GaussianArrays& gaussians, const Camera& camera, const Image& image);
  void render(const BakedArrays& scene, const Camera& camera, const Image& image);

  const Kernels& kernels() const { return kernels_; }
  std::mutex& mutex() { return mutex_; }
  // Visits the splats of the last frame in the order of the input.
  void for_each_splat(const std::function<void(const Splat&)>& visit) const;
  size_t splat_count() const { return items_.size(); }
  size_t pair_count() const { return pairs_.size(); }

 protected:
  // Splats of Gaussians [0, count), chunk by chunk: project(begin, end, splats, depth bits) returns
  // how many.
  void project(size_t count,
               const std::function<size_t(size_t, size_t, Splat*, uint32_t*)>& project);
  void sort();
  void bin(BinKernel kernel, int tiles_x, int tiles_y);
  void finish(const Camera& camera, const Image& image);

  const Kernels& kernels_;
  ThreadPool pool_;
  std::mutex mutex_;
  // Chunk c owns splats_[c * kChunkSize ...], of which the first chunk_counts_[c] are in use.
  std::vector<Splat> splats_;
  std::vector<uint32_t> depth_bits_;
  std::vector<size_t> chunk_counts_;
  std::vector<KeyValue> items_, sort_scratch_;  // visible splats, by depth after sorting
  std::vector<uint32_t> order_;
  struct BinTask {
    std::vector<TilePair> pairs;
    size_t count = 0;
    std::vector<uint32_t> tile_counts;  // then: where this task's pairs of a tile go
  };
  std::vector<BinTask> bin_tasks_;
  std::vector<uint32_t> tile_offsets_;
  std::vector<Pair> pairs_;
};

}  // namespace flysplat
