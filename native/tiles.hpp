// Which 4x4-pixel blocks of which tiles a splat touches.
#pragma once

#include "simd.hpp"
#include "types.hpp"

namespace splatpilot::SIMD_LEVEL {

// Pixels [first, last] along one axis whose centres lie within mean -+ extent; none if last <
// first.
struct PixelRange {
  int first, last;
};

SP_INLINE PixelRange pixel_range(float mean, float extent, int tiles) {
  // Pixel i has its centre at i + 1/2. Clamped as floats: extents may exceed any integer.
  const float low = mean - extent - 0.5f, high = mean + extent - 0.5f;
  const float limit = static_cast<float>(tiles * kTileSize);
  const float begin = low > 0.0f ? (low < limit ? low : limit) : 0.0f;
  const float end = high < limit ? high : limit - 0.5f;
  const int whole = static_cast<int>(begin);
  return {whole + (static_cast<float>(whole) < begin), end < 0.0f ? -1 : static_cast<int>(end)};
}

// The 16 blocks of a tile: pixel centres of block b span [left, left + 3] x [top, top + 3].
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
// convex quadratic with its minimum 0 at the mean, so over a rectangle it is least on the line
// x = (nearest x to the mean) or on y = (nearest y); on either line the minimum is a clamp.
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

// Which pixels a splat lies in, and which blocks of a tile it touches; of both a little more, so
// that rounding here never hides a pixel.
struct SplatFootprint {
  static SP_INLINE PixelRange columns(const Splat& s, int tiles) {
    return pixel_range(s.mean_x, s.extent_x * 1.0001f + 1e-3f, tiles);
  }
  static SP_INLINE PixelRange rows(const Splat& s, int tiles) {
    return pixel_range(s.mean_y, s.extent_y * 1.0001f + 1e-3f, tiles);
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
  for (; i < end; ++i) {
    if (i + kPrefetchAhead < end) __builtin_prefetch(splats + order[i + kPrefetchAhead]);
    const Splat& s = splats[order[i]];
    const PixelRange columns = Footprint::columns(s, tiles_x);
    const PixelRange rows = Footprint::rows(s, tiles_y);
    if (columns.last < columns.first || rows.last < rows.first) continue;
    const int first_column = columns.first / kTileSize, last_column = columns.last / kTileSize;
    const int first_row = rows.first / kTileSize, last_row = rows.last / kTileSize;
    const size_t most = static_cast<size_t>(last_column - first_column + 1) *
                        static_cast<size_t>(last_row - first_row + 1);
    if (count + most > capacity) break;
    for (int row = first_row; row <= last_row; ++row) {
      for (int column = first_column; column <= last_column; ++column) {
        const uint32_t blocks = Footprint::blocks(s, grid, static_cast<float>(column * kTileSize),
                                                  static_cast<float>(row * kTileSize));
        const uint32_t tile = static_cast<uint32_t>(row * tiles_x + column);
        pairs[count] = {tile, {order[i], blocks}};
        count += blocks != 0;
        tile_counts[tile] += blocks != 0;
      }
    }
  }
  *pair_count = count;
  return i;
}

}  // namespace splatpilot::SIMD_LEVEL
