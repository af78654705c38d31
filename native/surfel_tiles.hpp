// Which 4x4-pixel blocks of which tiles a surfel touches.
#pragma once

#include "surfel_types.hpp"
#include "tiles.hpp"

namespace splatpilot::SIMD_LEVEL {

// The blocks that hold a point of the disc.
SP_INLINE uint32_t blocks_of_disc(const Disc& disc, const BlockGrid& grid, float tile_left,
                                  float tile_top) {
  const F16 span = F16(static_cast<float>(kBlockSize - 1)), zero = F16(0.0f);
  const F16 x0 = grid.left + F16(tile_left - disc.x);
  const F16 y0 = grid.top + F16(tile_top - disc.y);
  const F16 x = clamp(zero, x0, x0 + span), y = clamp(zero, y0, y0 + span);
  return lane_bits(x * x + y * y <= F16(disc.radius * disc.radius));
}

SP_INLINE PixelRange united(const PixelRange& a, const PixelRange& b) {
  return {a.first < b.first ? a.first : b.first, a.last > b.last ? a.last : b.last};
}

// The ellipse's blocks and the disc's.
struct SurfelFootprint {
  // A little more, so that rounding never hides a pixel.
  static SP_INLINE Disc disc(const Splat& s) {
    const Disc d = disc_of(s);
    return {d.x, d.y, d.radius * 1.0001f + 1e-3f};
  }
  static SP_INLINE PixelRange columns(const Splat& s, int tiles) {
    const Disc d = disc(s);
    return united(SplatFootprint::columns(s, tiles), pixel_range(d.x, d.radius, tiles));
  }
  static SP_INLINE PixelRange rows(const Splat& s, int tiles) {
    const Disc d = disc(s);
    return united(SplatFootprint::rows(s, tiles), pixel_range(d.y, d.radius, tiles));
  }
  static SP_INLINE uint32_t blocks(const Splat& s, const BlockGrid& grid, float left, float top) {
    return SplatFootprint::blocks(s, grid, left, top) | blocks_of_disc(disc(s), grid, left, top);
  }
};

}  // namespace splatpilot::SIMD_LEVEL
