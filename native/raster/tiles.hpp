// The blocks of 4x4 pixels, of all tiles, that a splat touches.
#pragma once

#include "core/simd.hpp"
#include "core/types.hpp"

namespace splatpilot::SIMD_LEVEL {

constexpr int kTileBlocks = kTileSize / kBlockSize;  // on a side

// The blocks of the image that may hold a pixel of each of 16 splats; none if right < left or
// bottom < top.
struct BlockBoxes {
  alignas(64) int32_t left[kLanes], top[kLanes], right[kLanes], bottom[kLanes];
};

// Blocks [first, last] along one axis with a pixel center in [low, high], which reaches into the
// image: block b has them at 4 b + 1/2 to 4 b + 7/2.
SP_INLINE void block_range(const F16& low, const F16& high, int tiles, int32_t* first,
                           int32_t* last) {
  constexpr float kPerPixel = 1.0f / kBlockSize;
  // Clamped as floats: a box may exceed any integer.
  const F16 zero = F16(0.0f), end = F16(static_cast<float>(tiles * kTileBlocks - 1));
  store(first, to_int(clamp((low + F16(0.5f)) * F16(kPerPixel), zero, end)));
  store(last, to_int(clamp((high - F16(0.5f)) * F16(kPerPixel), zero, end)));
}

// The 16 blocks of a tile: pixel centers of block b span [left, left + 3] x [top, top + 3].
struct BlockGrid {
  F16 left, top;
};

SP_INLINE BlockGrid block_grid() {
  alignas(64) float left[kLanes], top[kLanes];
  for (int b = 0; b < kLanes; ++b) {
    left[b] = static_cast<float>(kBlockSize * (b % 4)) + 0.5f;
    top[b] = static_cast<float>(kBlockSize * (b / 4)) + 0.5f;
  }
  return {load(left), load(top)};
}

// The blocks that hold a point with alpha >= 1/255, one bit each. The squared norm u^2 + v^2 is a
// convex quadratic with its minimum 0 at the mean, so its minimum over a rectangle lies on the line
// x = (nearest x to the mean) or on y = (nearest y); on either line it is a clamp.
SP_INLINE uint32_t touched_blocks(const Splat& s, const BlockGrid& grid, float tile_left,
                                  float tile_top, float budget) {
  const F16 span = F16(static_cast<float>(kBlockSize - 1));
  const F16 x0 = grid.left + F16(tile_left - s.mean_x), x1 = x0 + span;
  const F16 y0 = grid.top + F16(tile_top - s.mean_y), y1 = y0 + span;
  const F16 zero = F16(0.0f);
  const F16 x = clamp(zero, x0, x1);
  const F16 y = clamp(zero, y0, y1);
  const F16 y_on_x = clamp(F16(s.slope_y) * x, y0, y1);
  const F16 x_on_y = clamp(F16(s.slope_x) * y, x0, x1);
  const F16 u1 = F16(s.ux) * x + F16(s.uy) * y_on_x, v1 = F16(s.vy) * y_on_x;
  const F16 u2 = F16(s.ux) * x_on_y + F16(s.uy) * y, v2 = F16(s.vy) * y;
  return lane_bits(min(u1 * u1 + v1 * v1, u2 * u2 + v2 * v2) <= F16(budget));
}

// The blocks of a box within one tile, of one or two a side; ends count from the image's corner.
SP_INLINE uint32_t blocks_of_box(int left, int top, int right, int bottom) {
  const uint32_t row = (1u << (left % kTileBlocks)) | (1u << (right % kTileBlocks));
  return (row << (kTileBlocks * (top % kTileBlocks))) |
         (row << (kTileBlocks * (bottom % kTileBlocks)));
}

// The blocks that splats touch, enlarged so that rounding never hides a pixel.
struct SplatFootprint {
  static SP_INLINE BlockBoxes boxes(const Splat* const* splats, int tiles_x, int tiles_y) {
    alignas(64) float fields[4][kLanes];
    for (int lane = 0; lane < kLanes; ++lane) {
      const Splat& s = *splats[lane];
      const float values[4] = {s.mean_x, s.mean_y, s.extent_x, s.extent_y};
      for (int f = 0; f < 4; ++f) fields[f][lane] = values[f];
    }
    const F16 x = load(fields[0]), y = load(fields[1]);
    const F16 reach_x = load(fields[2]) * F16(1.0001f) + F16(1e-3f);
    const F16 reach_y = load(fields[3]) * F16(1.0001f) + F16(1e-3f);
    BlockBoxes boxes;
    block_range(x - reach_x, x + reach_x, tiles_x, boxes.left, boxes.right);
    block_range(y - reach_y, y + reach_y, tiles_y, boxes.top, boxes.bottom);
    return boxes;
  }
  static SP_INLINE uint32_t blocks(const Splat& s, const BlockGrid& grid, float left, float top) {
    const float budget = (s.log2_opacity - kLog2AlphaCut) * 1.0001f + 1e-3f;
    return touched_blocks(s, grid, left, top, budget);
  }
};

// A BinKernel.
template <typename Footprint>
size_t bin_footprints(const Splat* splats, const uint32_t* order, size_t begin, size_t end,
                      int tiles_x, int tiles_y, TilePair* pairs, size_t capacity,
                      size_t* pair_count, uint32_t* tile_counts) {
  const BlockGrid grid = block_grid();
  size_t count = *pair_count;
  size_t i = begin;
  while (i < end) {
    const int lanes = end - i < kLanes ? static_cast<int>(end - i) : kLanes;
    const Splat* pack[kLanes];
    for (int lane = 0; lane < kLanes; ++lane) {
      pack[lane] = splats + order[lane < lanes ? i + lane : i];
      if (i + lane + kLanes < end) __builtin_prefetch(splats + order[i + lane + kLanes]);
    }
    const BlockBoxes boxes = Footprint::boxes(pack, tiles_x, tiles_y);
    for (int lane = 0; lane < lanes; ++lane, ++i) {
      const int left = boxes.left[lane], right = boxes.right[lane];
      const int top = boxes.top[lane], bottom = boxes.bottom[lane];
      if (right < left || bottom < top) continue;
      const int first_column = left / kTileBlocks, last_column = right / kTileBlocks;
      const int first_row = top / kTileBlocks, last_row = bottom / kTileBlocks;
      const size_t tiles = static_cast<size_t>(last_column - first_column + 1) *
                           static_cast<size_t>(last_row - first_row + 1);
      if (count + tiles > capacity) {
        *pair_count = count;
        return i;
      }
      const auto append = [&](int column, int row, uint32_t blocks) {
        const uint32_t tile = static_cast<uint32_t>(row * tiles_x + column);
        pairs[count] = {tile, {order[i], blocks}};
        count += blocks != 0;
        tile_counts[tile] += blocks != 0;
      };
      // A small splat touches nearly all blocks of its box; taking them all costs less than
      // testing.
      if (tiles == 1 && right - left <= 1 && bottom - top <= 1) {
        append(first_column, first_row, blocks_of_box(left, top, right, bottom));
        continue;
      }
      for (int row = first_row; row <= last_row; ++row) {
        for (int column = first_column; column <= last_column; ++column) {
          append(column, row,
                 Footprint::blocks(*pack[lane], grid, static_cast<float>(column * kTileSize),
                                   static_cast<float>(row * kTileSize)));
        }
      }
    }
  }
  *pair_count = count;
  return i;
}

}  // namespace splatpilot::SIMD_LEVEL
