// One frame: project, sort by depth, bin into tiles, composite.
#pragma once

#include <chrono>
#include <functional>
#include <memory>
#include <mutex>
#include <string>
#include <vector>

#include "projected.hpp"
#include "radix_sort.hpp"
#include "thread_pool.hpp"
#include "types.hpp"

namespace splatpilot {

struct CameraParameters {
  int width, height;
  double K[9];                   // row-major, [px]; skew is ignored
  double X_CW[16];               // world to camera, row-major
  double near_plane, far_plane;  // [m]
  double radius_clip, eps2d;     // [px], [px^2]
  bool antialiased;
};

Camera make_camera(const CameraParameters& parameters);

// Wall-clock seconds that the last frame's stages took.
struct StageSeconds {
  double project, sort, bin, raster;
  double raster_backward, gather, project_backward;
};

// What remains of a frame: splats and tile lists, and if it was rendered for a backward pass, what
// that pass starts from.
struct Frame {
  Camera camera;
  size_t gaussians = 0;  // in the input
  // Chunk c owns splats[c * kChunkSize ...], of which the first chunk_counts[c] are in use.
  std::vector<Splat> splats;
  std::vector<size_t> chunk_counts;
  std::vector<uint32_t> tile_offsets;
  std::vector<Pair> pairs;

  // For the backward pass, if `kept`. Splat i is in pairs[slots[k]] for k in ranges[i], by
  // increasing tile.
  bool kept = false;
  std::vector<PairRange> ranges;
  std::vector<uint32_t> slots;
  std::vector<uint32_t> later_stages, stages_done;
  std::vector<float> transmittance;

  size_t splat_count() const;
  // Where each chunk's splats start in the order of the input.
  std::vector<size_t> chunk_starts() const;
};

// Holds the scratch memory of a frame and the threads; memory is reused by the next frame and never
// influences it. Not for use by two threads at a time: hold mutex().
class Renderer {
 public:
  Renderer(int threads, const std::string& simd_level);

  // With `keep`, frame() can be handed to the backward passes, also after later frames.
  void render(const GaussianArrays& gaussians, const Camera& camera, const Image& image,
              bool keep = false);
  void render(const BakedArrays& scene, const Camera& camera, const Image& image);
  void render(const ProjectedArrays& projected, const Camera& camera, const Image& image,
              bool keep);

  std::shared_ptr<const Frame> frame() const { return frame_; }

  // From the image to the frame's splats, in the order of the input; `gradients` and
  // `means2d` (n, 2), a copy of SplatGradient::mean, hold frame.splat_count(). Returns how many
  // (splat, 4x4 block) were composited.
  size_t raster_backward(const Frame& frame, const ImageGradient& image, SplatGradient* gradients,
                         float* means2d);
  // From the splats to the Gaussians, which must be those of the frame; `means2d` (n, 2) stands in
  // for SplatGradient::mean.
  PoseSums project_backward(const Frame& frame, const GaussianArrays& gaussians,
                            const SplatGradient* gradients, const float* means2d,
                            const GaussianGradients& out);

  // Whether every number of the Gaussians can be rendered; `colors` are `color_floats` in all. May
  // be false for scales of less than the least normal number.
  bool are_valid(const GaussianArrays& gaussians, size_t color_floats);

  const StageSeconds& seconds() const { return seconds_; }
  const Kernels& kernels() const { return kernels_; }
  std::mutex& mutex() { return mutex_; }
  // Calls visit(i, splat) for the splats of the last frame, i counting them in the order of the
  // input; on all threads, in any order.
  template <typename Visit>
  void for_each_splat(const Visit& visit) {
    if (!frame_) return;
    const std::vector<size_t> starts = frame_->chunk_starts();
    pool_.for_each(starts.size(), [&](size_t chunk) {
      const Splat* splats = frame_->splats.data() + chunk * kChunkSize;
      for (size_t i = 0; i < frame_->chunk_counts[chunk]; ++i) {
        visit(starts[chunk] + i, splats[i]);
      }
    });
  }
  size_t splat_count() const { return items_.size(); }
  size_t pair_count() const { return frame_ ? frame_->pairs.size() : 0; }

 protected:
  void start_frame(const Camera& camera);
  // Splats of Gaussians [0, count), chunk by chunk: project(begin, end, splats, depth bits) returns
  // how many.
  void project(size_t count,
               const std::function<size_t(size_t, size_t, Splat*, uint32_t*)>& project);
  void sort();
  void bin(BinKernel kernel, int tiles_x, int tiles_y, bool keep);
  // Seconds since it was last called.
  double lap();

  ThreadPool pool_;
  StageSeconds seconds_{};
  std::shared_ptr<Frame> frame_;  // the last one

 private:
  void finish(const Image& image, bool keep);
  RasterInput raster_input(const Frame& frame) const;

  const Kernels& kernels_;
  std::mutex mutex_;
  std::chrono::steady_clock::time_point lap_start_;
  std::vector<std::shared_ptr<Frame>> frames_;  // all there are, for their memory
  std::vector<uint32_t> depth_bits_;
  std::vector<KeyValue> items_, sort_scratch_;  // visible splats, by depth after sorting
  std::vector<uint32_t> order_;
  struct BinTask {
    std::vector<TilePair> pairs;
    size_t count = 0;
    uint32_t first_slot = 0;
    std::vector<uint32_t> tile_counts;  // then: where this task's pairs of a tile go
  };
  std::vector<BinTask> bin_tasks_;
  std::vector<PairGradient> pair_gradients_;
};

}  // namespace splatpilot
