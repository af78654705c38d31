// The surfel kernels of one SIMD level, and the blocks of 4x4 pixels that surfels touch.
#include "raster/tiles.hpp"
#include "surfels/surfel_projection.hpp"
#include "surfels/surfel_raster.hpp"

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

// Boxes that hold those of a and b.
SP_INLINE BlockBoxes united(const BlockBoxes& a, const BlockBoxes& b) {
  BlockBoxes c;
  for (int lane = 0; lane < kLanes; ++lane) {
    c.left[lane] = a.left[lane] < b.left[lane] ? a.left[lane] : b.left[lane];
    c.top[lane] = a.top[lane] < b.top[lane] ? a.top[lane] : b.top[lane];
    c.right[lane] = a.right[lane] > b.right[lane] ? a.right[lane] : b.right[lane];
    c.bottom[lane] = a.bottom[lane] > b.bottom[lane] ? a.bottom[lane] : b.bottom[lane];
  }
  return c;
}

// The ellipse's blocks and the disc's.
struct SurfelFootprint {
  // Enlarged, so that rounding never hides a pixel.
  static SP_INLINE Disc disc(const Splat& s) {
    const Disc d = splatpilot::disc(s);
    return {d.x, d.y, d.radius * 1.0001f + 1e-3f};
  }
  static SP_INLINE BlockBoxes boxes(const Splat* const* splats, int tiles_x, int tiles_y) {
    alignas(64) float fields[3][kLanes];
    for (int lane = 0; lane < kLanes; ++lane) {
      const Disc d = disc(*splats[lane]);
      const float values[3] = {d.x, d.y, d.radius};
      for (int f = 0; f < 3; ++f) fields[f][lane] = values[f];
    }
    const F16 x = load(fields[0]), y = load(fields[1]), radius = load(fields[2]);
    BlockBoxes discs;
    block_range(x - radius, x + radius, tiles_x, discs.left, discs.right);
    block_range(y - radius, y + radius, tiles_y, discs.top, discs.bottom);
    return united(SplatFootprint::boxes(splats, tiles_x, tiles_y), discs);
  }
  static SP_INLINE uint32_t blocks(const Splat& s, const BlockGrid& grid, float left, float top) {
    return SplatFootprint::blocks(s, grid, left, top) | blocks_of_disc(disc(s), grid, left, top);
  }
};

extern const SurfelKernels kSurfelKernels;
const SurfelKernels kSurfelKernels = {project_surfels, bin_footprints<SurfelFootprint>,
                                      raster_surfels, raster_surfels_backward,
                                      project_surfels_backward};

}  // namespace splatpilot::SIMD_LEVEL
