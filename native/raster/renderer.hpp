// Frames: project, sort by depth, bin into tiles, composite; and the backward passes.
#pragma once

#include <atomic>
#include <deque>
#include <functional>
#include <memory>
#include <mutex>
#include <string>
#include <vector>

#include "core/radix_sort.hpp"
#include "core/thread_pool.hpp"
#include "core/types.hpp"
#include "project/camera.hpp"
#include "surfels/surfel_types.hpp"

namespace splatpilot {

struct Frame {
  Camera camera;
  size_t gaussians = 0;  // in the input
  // Chunk c uses the first chunk_counts[c] of splats[c * kChunkSize ...].
  std::vector<Splat> splats;
  std::vector<DepthPlane> planes;  // of the splats, for the median depth alone
  std::vector<size_t> chunk_counts;
  std::vector<size_t> tile_offsets;
  std::vector<Pair> pairs;

  // For the backward pass, if `kept`. Splat i is in pairs[slots[k]] for k in ranges[i], by
  // increasing tile.
  bool kept = false;
  std::vector<PairRange> ranges;
  std::vector<uint32_t> slots;
  std::vector<size_t> later_stages;
  std::vector<uint32_t> stages_done;
  std::vector<float> transmittance;

  int tiles_x() const { return (camera.width + kTileSize - 1) / kTileSize; }
  int tiles_y() const { return (camera.height + kTileSize - 1) / kTileSize; }
  size_t tiles() const { return static_cast<size_t>(tiles_x()) * static_cast<size_t>(tiles_y()); }
  size_t splat_count() const;
  // The start of each chunk's splats in the order of the input.
  std::vector<size_t> chunk_starts() const;
};

inline RasterInput raster_input(const Frame& frame) {
  return {frame.splats.data(), frame.planes.data(), frame.pairs.data(), frame.tile_offsets.data(),
          frame.camera.width,  frame.camera.height, frame.tiles_x()};
}

// Surfels are binned by the splats that bound them: surfels[i] belongs to bounds.splats[i].
struct SurfelFrame {
  Frame bounds;
  std::vector<Surfel> surfels;
  std::vector<SurfelBlockRecord> records;  // if bounds.kept
};

// Frames whose memory is reused once no other owner refers to them.
template <typename T>
class FramePool {
 public:
  std::shared_ptr<T> take() {
    for (const std::shared_ptr<T>& frame : frames_) {
      if (frame.use_count() > 1) continue;
      // The last reader released it on a thread of its own.
      std::atomic_thread_fence(std::memory_order_acquire);
      return frame;
    }
    return frames_.emplace_back(std::make_shared<T>());
  }

 private:
  std::vector<std::shared_ptr<T>> frames_;
};

// Threads and scratch memory, which is reused by the next frame and never influences it. One thread
// at a time: hold mutex(). Frames do not change once returned; with `keep` a backward pass can
// start from them at any later time.
class Renderer {
 public:
  Renderer(int threads, const std::string& simd_level);

  std::shared_ptr<const Frame> render(const GaussianArrays& gaussians, const Camera& camera,
                                      const Image& image, bool keep);
  // A baked scene, with moving Gaussians among it.
  std::shared_ptr<const Frame> render(const BakedArrays& scene, const GaussianArrays& moving,
                                      const Camera& camera, const Image& image);
  // From the image to the frame's splats, in the order of the input; `gradients` and
  // `means2d` (n, 2), a copy of SplatGradient::mean, hold frame.splat_count().
  void raster_backward(const Frame& frame, const ImageGradient& image, SplatGradient* gradients,
                       float* means2d);
  // From the splats to the Gaussians of the frame; `means2d` (n, 2) replaces SplatGradient::mean.
  PoseSums project_backward(const Frame& frame, const GaussianArrays& gaussians,
                            const SplatGradient* gradients, const float* means2d,
                            const GaussianGradients& out);

  std::shared_ptr<const SurfelFrame> render_surfels(const GaussianArrays& surfels,
                                                    const Camera& camera,
                                                    const SurfelImages<float>& images, bool keep);
  // From the images to the surfels of the kept frame.
  PoseSums surfels_backward(const SurfelFrame& frame, const GaussianArrays& surfels,
                            const SurfelImages<const float>& gradients,
                            const GaussianGradients& out);

  // Checks that every number of the Gaussians can be rendered. Subnormal scales may fail.
  bool are_valid(const GaussianArrays& gaussians);

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
  // Projects Gaussians [0, count), chunk by chunk, and their planes for `median_depth`. project()
  // returns the number of splats.
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
    std::vector<uint32_t> tile_counts;  // then: the slots of this task's pairs of a tile
  };
  std::vector<BinTask> bin_tasks_;
  std::vector<PairGradient> pair_gradients_;
  std::vector<SurfelGradient> surfel_pair_gradients_;
};

// Renderers of one thread each, for images at once. One call at a time.
class BatchRenderer {
 public:
  BatchRenderer(int threads, const std::string& simd_level) : pool_(threads) {
    for (int i = 0; i < threads; ++i) {
      idle_.push_back(&renderers_.emplace_back(1, simd_level));
    }
  }

  // Calls draw(renderer, i) for each image i in [0, count), on all threads.
  template <typename Draw>
  void for_each(size_t count, const Draw& draw) {
    const std::scoped_lock<std::mutex> call(call_mutex_);
    pool_.for_each(count, [&](size_t i) {
      const Loan loan(*this);
      draw(*loan.renderer, i);
    });
  }

 private:
  // A renderer that no other thread uses.
  struct Loan {
    BatchRenderer& batch;
    Renderer* renderer;

    explicit Loan(BatchRenderer& owner) : batch(owner) {
      const std::scoped_lock<std::mutex> lock(batch.idle_mutex_);
      renderer = batch.idle_.back();
      batch.idle_.pop_back();
    }
    ~Loan() {
      const std::scoped_lock<std::mutex> lock(batch.idle_mutex_);
      batch.idle_.push_back(renderer);
    }
  };

  std::mutex call_mutex_, idle_mutex_;
  ThreadPool pool_;
  std::deque<Renderer> renderers_;
  std::vector<Renderer*> idle_;
};

}  // namespace splatpilot
