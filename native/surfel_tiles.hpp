// Which 4x4-pixel blocks of which tiles a surfel touches.
#pragma once

#include "surfel_types.hpp"
#include "tiles.hpp"

namespace flysplat::FLYSPLAT_LEVEL {

// The blocks that hold a point of the disc.
FS_INLINE uint32_t blocks_of_disc(const Disc& disc, const BlockGrid& grid, float tile_left,
                                  float tile_top) {
  const F16 span = F16(static_cast<float>(kBlockSize - 1)), zero = F16(0.0f);
  const F16 x0 = grid.left + F16(tile_left - disc.x);
  const F16 y0 = grid.top + F16(tile_top - disc.y);
  const F16 x = clamp(zero, x0, x0 + span), y = clamp(zero, y0, y0 + span);
  return lane_bits(x * x + y * y <= F16(disc.radius * disc.radius));
}

inline size_t bin_surfels(const Splat* bounds, const uint32_t* order, size_t begin, size_t end,
                          int tiles_x, int tiles_y, TilePair* pairs, size_t capacity,
                          size_t* pair_count, uint32_t* tile_counts) {
  const BlockGrid grid = block_grid();
  size_t count = *pair_count;
  size_t i = begin;
  for (; i < end; ++i) {
    if (i + kPrefetchAhead < end) __builtin_prefetch(bounds + order[i + kPrefetchAhead]);
    const Splat& s = bounds[order[i]];
    // A little more, here and below, so that rounding never hides a pixel.
    Disc disc = disc_of(s);
    disc.radius = disc.radius * 1.0001f + 1e-3f;
    const TileRange disc_columns = tile_range(disc.x, disc.radius, tiles_x);
    const TileRange disc_rows = tile_range(disc.y, disc.radius, tiles_y);
    TileRange columns = tile_range(s.mean_x, s.extent_x, tiles_x);
    TileRange rows = tile_range(s.mean_y, s.extent_y, tiles_y);
    if (disc_columns.first < columns.first) columns.first = disc_columns.first;
    if (disc_columns.last > columns.last) columns.last = disc_columns.last;
    if (disc_rows.first < rows.first) rows.first = disc_rows.first;
    if (disc_rows.last > rows.last) rows.last = disc_rows.last;
    if (columns.last < columns.first || rows.last < rows.first) continue;
    const size_t most = static_cast<size_t>(columns.last - columns.first + 1) *
                        static_cast<size_t>(rows.last - rows.first + 1);
    if (count + most > capacity) break;
    const float budget = (s.log2_opacity - kLog2AlphaCut) * 1.0001f + 1e-3f;
    for (int row = rows.first; row <= rows.last; ++row) {
      for (int column = columns.first; column <= columns.last; ++column) {
        const float left = static_cast<float>(column * kTileSize);
        const float top = static_cast<float>(row * kTileSize);
        const uint32_t blocks = touched_blocks(s, grid, left, top, budget) |
                                blocks_of_disc(disc, grid, left, top);
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

}  // namespace flysplat::FLYSPLAT_LEVEL
