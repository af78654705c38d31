// What remains of a rendered image: splats and tile lists, and what a backward pass starts from.
#pragma once

#include <atomic>
#include <memory>
#include <vector>

#include "core/types.hpp"
#include "surfels/surfel_types.hpp"

namespace splatpilot {

struct Frame {
  Camera camera;
  size_t gaussians = 0;  // in the input
  // Chunk c owns splats[c * kChunkSize ...], of which the first chunk_counts[c] are in use.
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
  // Where each chunk's splats start in the order of the input.
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

// Frames whose memory is used again when nobody else refers to them.
template <typename T>
class FramePool {
 public:
  std::shared_ptr<T> take() {
    for (const std::shared_ptr<T>& frame : frames_) {
      if (frame.use_count() > 1) continue;
      // The last reader let go of it on a thread of its own.
      std::atomic_thread_fence(std::memory_order_acquire);
      return frame;
    }
    return frames_.emplace_back(std::make_shared<T>());
  }

 private:
  std::vector<std::shared_ptr<T>> frames_;
};

}  // namespace splatpilot
