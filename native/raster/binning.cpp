// The stages of a frame that Gaussians and surfels share, up to the pairs of tiles.
#include <algorithm>

#include "project/pair_count.hpp"
#include "raster/renderer.hpp"

namespace splatpilot {

void Renderer::project(Frame& frame, size_t count, bool median_depth, const ProjectChunk& project) {
  const size_t chunks = (count + kChunkSize - 1) / kChunkSize;
  frame.gaussians = count;
  frame.chunk_counts.resize(chunks);
  if (frame.splats.size() < count) frame.splats.resize(count);
  if (median_depth && frame.planes.size() < count) frame.planes.resize(count);
  if (depth_bits_.size() < count) depth_bits_.resize(count);
  pool_.for_each(chunks, [&](size_t chunk) {
    const size_t begin = chunk * kChunkSize;
    frame.chunk_counts[chunk] =
        project(begin, std::min(count, begin + kChunkSize), frame.splats.data() + begin,
                median_depth ? frame.planes.data() + begin : nullptr, depth_bits_.data() + begin);
  });
}

void Renderer::sort(const Frame& frame) {
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
}

// Counts the pairs of each tile and each task, then stores them by the counts. Tasks are
// consecutive ranges of the depth order, so the lists do not depend on their number.
void Renderer::bin(Frame& frame, BinKernel kernel) {
  const size_t tiles = frame.tiles();
  const size_t tasks = pool_.threads() == 1 ? 1 : 2 * static_cast<size_t>(pool_.threads());
  const size_t visible = order_.size();
  bin_tasks_.resize(tasks);
  if (frame.kept) frame.ranges.resize(frame.splats.size());
  pool_.for_each(tasks, [&](size_t t) {
    BinTask& task = bin_tasks_[t];
    task.tile_counts.assign(tiles, 0);
    task.count = 0;
    const size_t end = visible * (t + 1) / tasks;
    if (frame.kept) {
      for (size_t i = visible * t / tasks; i < end; ++i) frame.ranges[order_[i]] = {0, 0};
    }
    for (size_t i = visible * t / tasks; i < end;) {
      i = kernel(frame.splats.data(), order_.data(), i, end, frame.tiles_x(), frame.tiles_y(),
                 task.pairs.data(), task.pairs.size(), &task.count, task.tile_counts.data());
      if (i < end) task.pairs.resize(2 * task.pairs.size() + tiles + visible);
    }
  });

  size_t pairs = 0;
  for (BinTask& task : bin_tasks_) {
    task.first_slot = pairs;
    pairs += task.count;
  }
  check_pair_count(pairs);
  frame.pairs.resize(pairs);
  if (frame.kept) frame.slots.resize(pairs);
  frame.tile_offsets.resize(tiles + 1);
  size_t sum = 0;
  for (size_t tile = 0; tile < tiles; ++tile) {
    frame.tile_offsets[tile] = sum;
    for (BinTask& task : bin_tasks_) {
      const uint32_t count = task.tile_counts[tile];
      task.tile_counts[tile] = static_cast<uint32_t>(sum);
      sum += count;
    }
  }
  frame.tile_offsets[tiles] = sum;
  pool_.for_each(tasks, [&](size_t t) {
    BinTask& task = bin_tasks_[t];
    for (size_t i = 0; i < task.count; ++i) {
      const TilePair& p = task.pairs[i];
      const uint32_t slot = task.tile_counts[p.tile]++;
      frame.pairs[slot] = p.pair;
      if (!frame.kept) continue;
      const uint32_t k = static_cast<uint32_t>(task.first_slot + i);
      frame.slots[k] = slot;
      PairRange& range = frame.ranges[p.pair.splat];
      if (range.end == 0) range.begin = k;
      range.end = k + 1;
    }
  });
}

}  // namespace splatpilot
