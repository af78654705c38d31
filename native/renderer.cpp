#include "renderer.hpp"

#include <algorithm>
#include <atomic>
#include <cmath>
#include <limits>
#include <numeric>

#include "dispatch.hpp"

namespace splatpilot {

Camera make_camera(const CameraParameters& p) {
  Camera c{};
  c.width = p.width;
  c.height = p.height;
  const double fx = p.K[0], cx = p.K[2], fy = p.K[4], cy = p.K[5];
  c.fx = static_cast<float>(fx);
  c.fy = static_cast<float>(fy);
  c.cx = static_cast<float>(cx);
  c.cy = static_cast<float>(cy);
  c.near_plane = static_cast<float>(p.near_plane);
  c.far_plane = static_cast<float>(p.far_plane);
  // A splat is clipped when its radius, rounded up, does not exceed the limit.
  c.radius_clip = static_cast<float>(std::floor(p.radius_clip));
  c.eps2d = static_cast<float>(p.eps2d);
  c.antialiased = p.antialiased;

  // centre = -R^-1 t by cofactors: R may be a rotation only to single precision.
  double R[3][3], t[3];
  for (int i = 0; i < 3; ++i) {
    for (int j = 0; j < 3; ++j) {
      R[i][j] = p.X_CW[4 * i + j];
      c.R_CW[3 * i + j] = static_cast<float>(R[i][j]);
    }
    t[i] = p.X_CW[4 * i + 3];
  }
  double cofactor[3][3], det = 0.0;
  for (int i = 0; i < 3; ++i) {
    for (int j = 0; j < 3; ++j) {
      const int i1 = (i + 1) % 3, i2 = (i + 2) % 3, j1 = (j + 1) % 3, j2 = (j + 2) % 3;
      cofactor[i][j] = R[i1][j1] * R[i2][j2] - R[i1][j2] * R[i2][j1];
    }
  }
  for (int j = 0; j < 3; ++j) det += R[0][j] * cofactor[0][j];
  for (int j = 0; j < 3; ++j) {
    double centre = 0.0;
    for (int i = 0; i < 3; ++i) centre -= cofactor[i][j] * t[i] / det;
    c.centre_high[j] = static_cast<float>(centre);
    c.centre_low[j] = static_cast<float>(centre - c.centre_high[j]);
  }

  // The slopes x/z and y/z that enter the Jacobian stay within the image plus 15 % of its size.
  const double margin_x = 0.15 * p.width / fx, margin_y = 0.15 * p.height / fy;
  const double min_x = -cx / fx - margin_x, max_x = (p.width - cx) / fx + margin_x;
  const double min_y = -cy / fy - margin_y, max_y = (p.height - cy) / fy + margin_y;
  c.min_slope_x = static_cast<float>(min_x);
  c.max_slope_x = static_cast<float>(max_x);
  c.min_slope_y = static_cast<float>(min_y);
  c.max_slope_y = static_cast<float>(max_y);

  // |J_x| <= fx / z sqrt(1 + slope^2), so the extent is at most kMaxExtent (|J_x| s + sqrt(eps2d)):
  // left of the image means fx x / z + cx + extent <= 0, which times z is linear. A pixel and 1 %
  // are added for rounding.
  const double steep_x = std::sqrt(1.0 + std::max(min_x * min_x, max_x * max_x));
  const double steep_y = std::sqrt(1.0 + std::max(min_y * min_y, max_y * max_y));
  const double blur = kMaxExtent * std::sqrt(p.eps2d) + 1.0;
  const double sides[4][4] = {{fx, 0, cx + blur, fx * steep_x},
                              {-fx, 0, p.width - cx + blur, fx * steep_x},
                              {0, fy, cy + blur, fy * steep_y},
                              {0, -fy, p.height - cy + blur, fy * steep_y}};
  for (int side = 0; side < 4; ++side) {
    for (int axis = 0; axis < 3; ++axis) {
      c.side_normal[side][axis] = static_cast<float>(sides[side][axis]);
    }
    c.side_reach[side] = static_cast<float>(1.01 * kMaxExtent * sides[side][3]);
  }
  return c;
}

Renderer::Renderer(int threads, const std::string& simd_level)
    : pool_(threads), kernels_(splatpilot::kernels(simd_level)) {}

void Renderer::render(const GaussianArrays& gaussians, const Camera& camera, const Image& image,
                      bool keep) {
  start_frame(camera);
  project(gaussians.count, [&](size_t begin, size_t end, Splat* splats, uint32_t* depth_bits) {
    return kernels_.project(gaussians, camera, begin, end, splats, depth_bits);
  });
  finish(image, keep);
}

void Renderer::render(const BakedArrays& scene, const Camera& camera, const Image& image) {
  start_frame(camera);
  project(scene.groups * 16, [&](size_t begin, size_t end, Splat* splats, uint32_t* depth_bits) {
    return kernels_.project_baked(scene, camera, begin, end, splats, depth_bits);
  });
  finish(image, false);
}

void Renderer::render(const ProjectedArrays& projected, const Camera& camera, const Image& image,
                      bool keep) {
  start_frame(camera);
  project(projected.count, [&](size_t begin, size_t end, Splat* splats, uint32_t* depth_bits) {
    return place_splats(projected, camera, begin, end, splats, depth_bits);
  });
  finish(image, keep);
}

size_t Frame::splat_count() const {
  return std::accumulate(chunk_counts.begin(), chunk_counts.end(), size_t{0});
}

std::vector<size_t> Frame::chunk_starts() const {
  std::vector<size_t> starts(chunk_counts.size());
  std::exclusive_scan(chunk_counts.begin(), chunk_counts.end(), starts.begin(), size_t{0});
  return starts;
}

double Renderer::lap() {
  const auto now = std::chrono::steady_clock::now();
  const std::chrono::duration<double> passed = now - lap_start_;
  lap_start_ = now;
  return passed.count();
}

bool Renderer::are_valid(const GaussianArrays& g, size_t color_floats) {
  constexpr float kMost = std::numeric_limits<float>::max();
  constexpr float kLeast = std::numeric_limits<float>::min();
  const size_t chunks = (g.count + kChunkSize - 1) / kChunkSize;
  std::atomic<bool> valid{true};
  pool_.for_each(chunks, [&](size_t chunk) {
    const size_t begin = chunk * kChunkSize;
    const size_t count = std::min(g.count - begin, size_t{kChunkSize});
    const size_t color_begin = color_floats * chunk / chunks;
    const size_t color_count = color_floats * (chunk + 1) / chunks - color_begin;
    if (!kernels_.all_within(g.means + 3 * begin, 3 * count, -kMost, kMost) ||
        !kernels_.all_normalisable(g.quats + 4 * begin, count) ||
        !kernels_.all_within(g.scales + 3 * begin, 3 * count, kLeast, kMost) ||
        !kernels_.all_within(g.opacities + begin, count, 0.0f, 1.0f) ||
        !kernels_.all_within(g.colors + color_begin, color_count, -kMost, kMost)) {
      valid.store(false, std::memory_order_relaxed);
    }
  });
  return valid;
}

// Takes memory that no backward pass waits for.
void Renderer::start_frame(const Camera& camera) {
  frame_.reset();
  const auto is_free = [](const std::shared_ptr<Frame>& f) { return f.use_count() == 1; };
  const auto found = std::find_if(frames_.begin(), frames_.end(), is_free);
  frame_ = found == frames_.end() ? frames_.emplace_back(std::make_shared<Frame>()) : *found;
  frame_->camera = camera;
  frame_->kept = false;
  lap();
}

void Renderer::project(size_t count,
                       const std::function<size_t(size_t, size_t, Splat*, uint32_t*)>& project) {
  Frame& frame = *frame_;
  const size_t chunks = (count + kChunkSize - 1) / kChunkSize;
  frame.gaussians = count;
  frame.chunk_counts.resize(chunks);
  if (frame.splats.size() < count) frame.splats.resize(count);
  if (depth_bits_.size() < count) depth_bits_.resize(count);
  pool_.for_each(chunks, [&](size_t chunk) {
    const size_t begin = chunk * kChunkSize;
    frame.chunk_counts[chunk] = project(begin, std::min(count, begin + kChunkSize),
                                        frame.splats.data() + begin, depth_bits_.data() + begin);
  });
  seconds_.project = lap();
}

// Counts the pairs of each tile and each task, then puts every pair where the counts say. Tasks are
// consecutive ranges of the depth order, so the lists do not depend on how many there are.
void Renderer::bin(BinKernel kernel, int tiles_x, int tiles_y, bool keep) {
  Frame& frame = *frame_;
  const size_t tiles = static_cast<size_t>(tiles_x) * static_cast<size_t>(tiles_y);
  const size_t tasks = pool_.threads() == 1 ? 1 : 2 * static_cast<size_t>(pool_.threads());
  const size_t visible = order_.size();
  bin_tasks_.resize(tasks);
  if (keep) frame.ranges.resize(frame.splats.size());
  pool_.for_each(tasks, [&](size_t t) {
    BinTask& task = bin_tasks_[t];
    task.tile_counts.assign(tiles, 0);
    task.count = 0;
    const size_t end = visible * (t + 1) / tasks;
    if (keep) {
      for (size_t i = visible * t / tasks; i < end; ++i) frame.ranges[order_[i]] = {0, 0};
    }
    for (size_t i = visible * t / tasks; i < end;) {
      i = kernel(frame.splats.data(), order_.data(), i, end, tiles_x, tiles_y, task.pairs.data(),
                 task.pairs.size(), &task.count, task.tile_counts.data());
      if (i < end) task.pairs.resize(2 * task.pairs.size() + tiles + visible);
    }
  });

  frame.tile_offsets.resize(tiles + 1);
  uint32_t sum = 0;
  for (size_t tile = 0; tile < tiles; ++tile) {
    frame.tile_offsets[tile] = sum;
    for (BinTask& task : bin_tasks_) {
      const uint32_t count = task.tile_counts[tile];
      task.tile_counts[tile] = sum;
      sum += count;
    }
  }
  frame.tile_offsets[tiles] = sum;
  frame.pairs.resize(sum);
  if (keep) {
    frame.slots.resize(sum);
    uint32_t first = 0;
    for (BinTask& task : bin_tasks_) {
      task.first_slot = first;
      first += static_cast<uint32_t>(task.count);
    }
  }
  pool_.for_each(tasks, [&](size_t t) {
    BinTask& task = bin_tasks_[t];
    for (size_t i = 0; i < task.count; ++i) {
      const TilePair& p = task.pairs[i];
      const uint32_t slot = task.tile_counts[p.tile]++;
      frame.pairs[slot] = p.pair;
      if (!keep) continue;
      const uint32_t k = task.first_slot + static_cast<uint32_t>(i);
      frame.slots[k] = slot;
      PairRange& range = frame.ranges[p.pair.splat];
      if (range.end == 0) range.begin = k;
      range.end = k + 1;
    }
  });
  seconds_.bin = lap();
}

void Renderer::sort() {
  const Frame& frame = *frame_;
  const std::vector<size_t> starts = frame.chunk_starts();
  items_.resize(frame.splat_count());
  pool_.for_each(starts.size(), [&](size_t chunk) {
    const size_t first = chunk * kChunkSize;
    for (size_t i = 0; i < frame.chunk_counts[chunk]; ++i) {
      items_[starts[chunk] + i] = {depth_bits_[first + i], static_cast<uint32_t>(first + i)};
    }
  });
  radix_sort(items_, sort_scratch_);
  order_.resize(items_.size());
  for (size_t i = 0; i < items_.size(); ++i) order_[i] = items_[i].value;
  seconds_.sort = lap();
}

RasterInput Renderer::raster_input(const Frame& frame) const {
  RasterInput in{};
  in.splats = frame.splats.data();
  in.pairs = frame.pairs.data();
  in.tile_offsets = frame.tile_offsets.data();
  in.width = frame.camera.width;
  in.height = frame.camera.height;
  in.tiles_x = (in.width + kTileSize - 1) / kTileSize;
  return in;
}

void Renderer::finish(const Image& image, bool keep) {
  Frame& frame = *frame_;
  frame.kept = keep;
  sort();
  const int tiles_x = (frame.camera.width + kTileSize - 1) / kTileSize;
  const int tiles_y = (frame.camera.height + kTileSize - 1) / kTileSize;
  bin(kernels_.bin, tiles_x, tiles_y, keep);
  const size_t tiles = frame.tile_offsets.size() - 1;
  RasterInput input = raster_input(frame);
  input.image = image;
  if (keep) {
    frame.later_stages.resize(tiles + 1);
    frame.stages_done.resize(tiles);
    uint32_t stages = 0;
    for (size_t tile = 0; tile < tiles; ++tile) {
      frame.later_stages[tile] = stages;
      const uint32_t count = frame.tile_offsets[tile + 1] - frame.tile_offsets[tile];
      stages += count > kStageSize ? (count - 1) / kStageSize : 0;
    }
    frame.later_stages[tiles] = stages;
    const size_t floats = size_t{stages} * kTileSize * kTileSize;
    if (frame.transmittance.size() < floats) frame.transmittance.resize(floats);
    input.later_stages = frame.later_stages.data();
    input.transmittance = frame.transmittance.data();
    input.stages_done = frame.stages_done.data();
  }
  pool_.for_each(tiles, [&](size_t tile) { kernels_.raster_tile(input, static_cast<int>(tile)); });
  seconds_.raster = lap();
}

}  // namespace splatpilot
