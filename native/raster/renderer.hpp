// Frames: project, sort by depth, bin into tiles, composite; and the way back.
#pragma once

#include <functional>
#include <memory>
#include <mutex>
#include <string>
#include <vector>

#include "core/frame.hpp"
#include "core/radix_sort.hpp"
#include "core/thread_pool.hpp"
#include "core/types.hpp"
#include "project/camera.hpp"

namespace splatpilot {

// Holds threads and scratch memory, which is reused by the next frame and never influences it. Not
// for use by two threads at a time: hold mutex(). Frames do not change any more once they are
// returned, and with `keep` a backward pass can start from them at any later time.
class Renderer {
 public:
  Renderer(int threads, const std::string& simd_level);

  std::shared_ptr<const Frame> render(const GaussianArrays& gaussians, const Camera& camera,
                                      const Image& image, bool keep);
  // A baked scene, and among it Gaussians that are not: those that move.
  std::shared_ptr<const Frame> render(const BakedArrays& scene, const GaussianArrays& moving,
                                      const Camera& camera, const Image& image);
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

  std::shared_ptr<const SurfelFrame> render_surfels(const GaussianArrays& surfels,
                                                    const Camera& camera,
                                                    const SurfelImages<float>& images, bool keep);
  // From the images to the surfels, which must be those of the kept frame.
  PoseSums surfels_backward(const SurfelFrame& frame, const GaussianArrays& surfels,
                            const SurfelImages<const float>& gradients,
                            const GaussianGradients& out);

  // Whether every number of the Gaussians can be rendered; `colors` are `color_floats` in all. May
  // be false for scales of less than the least normal number.
  bool are_valid(const GaussianArrays& gaussians, size_t color_floats);

  const Kernels& kernels() const { return kernels_; }
  std::mutex& mutex() { return mutex_; }
  // Calls visit(i, splat) for the splats of a frame, i counting them in the order of the input; on
  // all threads, in any order.
  template <typename Visit>
  void for_each_splat(const Frame& frame, const Visit& visit) {
    const std::vector<size_t> starts = frame.chunk_starts();
    pool_.for_each(starts.size(), [&](size_t chunk) {
      const Splat* splats = frame.splats.data() + chunk * kChunkSize;
      for (size_t i = 0; i < frame.chunk_counts[chunk]; ++i) visit(starts[chunk] + i, splats[i]);
    });
  }

 private:
  using ProjectChunk = std::function<size_t(size_t begin, size_t end, Splat* splats,
                                            DepthPlane* planes, uint32_t* depth_bits)>;
  void start(Frame& frame, const Camera& camera, bool keep);
  // Splats of Gaussians [0, count), chunk by chunk, and their planes for `median_depth`: project()
  // returns how many.
  void project(Frame& frame, size_t count, bool median_depth, const ProjectChunk& project);
  void sort(const Frame& frame);
  void bin(Frame& frame, BinKernel kernel);
  void composite(Frame& frame, const Image& image);
  std::shared_ptr<const Frame> draw(const Camera& camera, const Image& image, bool keep,
                                    size_t count, const ProjectChunk& project);
  // Sets a chunk's rows to zero where they are to be overwritten.
  static void clear_chunk(const GaussianArrays& gaussians, size_t chunk,
                          const GaussianGradients& out);
  static PoseSums total(const std::vector<PoseSums>& parts);

  const Kernels& kernels_;
  std::mutex mutex_;
  ThreadPool pool_;
  FramePool<Frame> frames_;
  FramePool<SurfelFrame> surfel_frames_;
  std::vector<uint32_t> depth_bits_;
  std::vector<KeyValue<uint32_t>> items_, sort_scratch_;  // visible splats, by depth after sorting
  std::vector<uint32_t> order_;
  struct BinTask {
    std::vector<TilePair> pairs;
    size_t count = 0;
    size_t first_slot = 0;
    std::vector<uint32_t> tile_counts;  // then: where this task's pairs of a tile go
  };
  std::vector<BinTask> bin_tasks_;
  std::vector<PairGradient> pair_gradients_;
  std::vector<SurfelGradient> surfel_pair_gradients_;
};

}  // namespace splatpilot
