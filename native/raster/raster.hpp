// Alpha compositing of one tile, front to back, 16 pixels at a time.
#pragma once

#include "project/footprints.hpp"
#include "raster/tile_blocks.hpp"

namespace splatpilot::SIMD_LEVEL {

// Running sums of the 16 pixels of a block. Transmittance never grows, so a pixel whose next value
// would not exceed the limit is finished for good: that one comparison takes the place of a mask
// carried from splat to splat. Pixels outside the image start at 0, finished.
struct BlockState {
  F16 transmittance, red, green, blue, depth, alpha;
  // Of the median depth: what footprints without blur let through, and the inverse depth at which
  // that fell to one half, if it did.
  F16 sharp_transmittance, median_w;
};

// Composites the staged splats of one block; returns whether any pixel is still open. A pixel whose
// color is finished is open while its median depth is sought.
template <bool kColor, bool kDepth, bool kMedian>
SP_INLINE bool composite(const StagedTile& staged, int words, int b, const LaneCenters& pixel,
                         BlockState& state) {
  BlockState s = state;
  bool open = true, seeking = kMedian;
  TouchingSplats touching(staged, words, b);
  int indices[kGroupSize];
  while (open && touching.next(indices)) {
    F16 alphas[kGroupSize];
    SP_EACH_OF(kGroupSize, n) { alphas[n] = alpha_at(staged.splats[indices[n]], pixel.x, pixel.y); }
    if constexpr (kMedian) {
      for (int n = 0; n < kGroupSize && seeking; ++n) {
        seeking = seek_median(staged.planes[indices[n]], staged.splats[indices[n]].log2_opacity,
                              pixel.x, pixel.y, s.sharp_transmittance, s.median_w);
      }
    }
    Mask16 keep;
    SP_EACH_OF(kGroupSize, n) {
      const StagedSplat& splat = staged.splats[indices[n]];
      const F16 rest = s.transmittance * (F16(1.0f) - alphas[n]);
      keep = rest > F16(kMinTransmittance);
      const F16 weight = zero_unless(keep, s.transmittance * alphas[n]);
      s.transmittance = rest;
      s.alpha += weight;
      if constexpr (kColor) {
        s.red += weight * F16(splat.red);
        s.green += weight * F16(splat.green);
        s.blue += weight * F16(splat.blue);
      }
      if constexpr (kDepth) s.depth += weight * F16(splat.depth);
    }
    if (!any(keep)) {
      open = seeking;
      s.transmittance = max(s.transmittance, F16(1e-20f));  // and never a subnormal number
    }
  }
  state = s;
  return open;
}

// The pixels of one block of the image, ready to be written.
struct BlockPixels {
  alignas(64) float red[kLanes], green[kLanes], blue[kLanes], depth[kLanes], alpha[kLanes];
};

// Where half of the light is let through, z at that inverse depth; else 0.
SP_INLINE F16 median_depth(const F16& transmittance, const F16& median_w) {
  const F16 z = F16(1.0f) / max(median_w, F16(1e-10f));
  return zero_unless(transmittance <= F16(0.5f), z);
}

template <bool kColor, bool kDepth, bool kMedian>
SP_INLINE void finish_block(const Image& image, const BlockState& state, BlockPixels& pixels) {
  store(pixels.alpha, state.alpha);
  if constexpr (kColor) {
    const F16 rest = F16(1.0f) - state.alpha;
    store(pixels.red, state.red + rest * F16(image.background[0]));
    store(pixels.green, state.green + rest * F16(image.background[1]));
    store(pixels.blue, state.blue + rest * F16(image.background[2]));
  }
  if constexpr (kDepth) {
    const bool expected = image.depth_mode == DepthMode::kExpected;
    store(pixels.depth, expected ? state.depth / max(state.alpha, F16(1e-10f)) : state.depth);
  }
  if constexpr (kMedian) {
    store(pixels.depth, median_depth(state.sharp_transmittance, state.median_w));
  }
}

template <bool kColor, bool kDepth, bool kMedian>
SP_INLINE void write_block(const Image& image, const BlockState& state, int width, int height,
                           int left, int top) {
  BlockPixels pixels;
  finish_block<kColor, kDepth, kMedian>(image, state, pixels);
  for_each_pixel(width, height, left, top, [&](int lane, size_t pixel) {
    image.alpha[pixel] = pixels.alpha[lane];
    if constexpr (kColor) {
      float* color = image.color + pixel * image.color_stride;
      color[0] = pixels.red[lane];
      color[1] = pixels.green[lane];
      color[2] = pixels.blue[lane];
    }
    if constexpr (kDepth || kMedian) image.depth[pixel * image.depth_stride] = pixels.depth[lane];
  });
}

template <bool kColor, bool kDepth, bool kMedian>
void raster_tile_channels(const RasterInput& in, const Image& image, const StageWriter* record,
                          int tile) {
  const int left = tile % in.tiles_x * kTileSize, top = tile / in.tiles_x * kTileSize;
  const LaneCenters centers = lane_centers();
  BlockState state[kBlocksPerTile];
  uint32_t inside = 0;
  for (int b = 0; b < kBlocksPerTile; ++b) {
    const F16 zero = F16(0.0f);
    const F16 open = ones_inside(in.width, in.height, centers, left, top, b);
    state[b] = {open, zero, zero, zero, zero, zero, open, zero};
    if (any(state[b].transmittance > zero)) inside |= 1u << b;
  }

  StagedTile staged;
  uint32_t live = inside;
  uint32_t seeking = kMedian ? inside : 0;  // blocks with pixels that have no median yet
  const size_t end = in.tile_offsets[tile + 1];
  uint32_t stages = 0;
  for (size_t begin = in.tile_offsets[tile]; begin < end && live; begin += kStageSize) {
    if (record && stages > 0) {
      const size_t saved = record->later_stages[tile] + stages - 1;
      float* transmittance = record->transmittance + saved * kTileSize * kTileSize;
      for (int b = 0; b < kBlocksPerTile; ++b) {
        store(transmittance + kLanes * b, state[b].transmittance);
      }
    }
    ++stages;
    const int count = end - begin < kStageSize ? static_cast<int>(end - begin) : kStageSize;
    stage(in, seeking != 0, begin, count, static_cast<float>(left), static_cast<float>(top),
          staged);
    const int words = (count + 63) / 64;
    for (uint32_t bits = live; bits; bits &= bits - 1) {
      const int b = __builtin_ctz(bits);
      const LaneCenters pixel = block_centers(centers, b);
      const bool seeks = kMedian && (seeking >> b & 1);
      const bool open = seeks
                            ? composite<kColor, kDepth, kMedian>(staged, words, b, pixel, state[b])
                            : composite<kColor, kDepth, false>(staged, words, b, pixel, state[b]);
      if (seeks && !any(state[b].sharp_transmittance > F16(0.5f))) seeking &= ~(1u << b);
      if (!open) live &= ~(1u << b);
    }
  }
  if (record) record->stages_done[tile] = stages;
  for (uint32_t bits = inside; bits; bits &= bits - 1) {
    const int b = __builtin_ctz(bits);
    write_block<kColor, kDepth, kMedian>(image, state[b], in.width, in.height,
                                         left + kBlockSize * (b % 4), top + kBlockSize * (b / 4));
  }
}

// Seeks the median depth of one block among the staged splats; returns whether a pixel has none
// yet.
SP_INLINE bool seek_block(const StagedTile& staged, int words, int b, const LaneCenters& pixel,
                          F16& transmittance, F16& median_w) {
  for (int word = 0; word < words; ++word) {
    for (uint64_t bits = staged.touching[b][word]; bits; bits &= bits - 1) {
      const int i = 64 * word + __builtin_ctzll(bits);
      if (!seek_median(staged.planes[i], staged.splats[i].log2_opacity, pixel.x, pixel.y,
                       transmittance, median_w)) {
        return false;
      }
    }
  }
  return true;
}

// The median depth of one tile and nothing else, with the bits of `raster_tile_channels`.
inline void seek_tile(const RasterInput& in, const Image& image, int tile) {
  const int left = tile % in.tiles_x * kTileSize, top = tile / in.tiles_x * kTileSize;
  const LaneCenters centers = lane_centers();
  F16 transmittance[kBlocksPerTile], median_w[kBlocksPerTile];
  uint32_t inside = 0;
  for (int b = 0; b < kBlocksPerTile; ++b) {
    transmittance[b] = ones_inside(in.width, in.height, centers, left, top, b);
    median_w[b] = F16(0.0f);
    if (any(transmittance[b] > F16(0.0f))) inside |= 1u << b;
  }
  StagedTile staged;
  uint32_t seeking = inside;
  const size_t end = in.tile_offsets[tile + 1];
  for (size_t begin = in.tile_offsets[tile]; begin < end && seeking; begin += kStageSize) {
    const int count = end - begin < kStageSize ? static_cast<int>(end - begin) : kStageSize;
    stage(in, true, begin, count, static_cast<float>(left), static_cast<float>(top), staged);
    for (uint32_t bits = seeking; bits; bits &= bits - 1) {
      const int b = __builtin_ctz(bits);
      const LaneCenters pixel = block_centers(centers, b);
      if (!seek_block(staged, (count + 63) / 64, b, pixel, transmittance[b], median_w[b])) {
        seeking &= ~(1u << b);
      }
    }
  }
  for (uint32_t bits = inside; bits; bits &= bits - 1) {
    const int b = __builtin_ctz(bits);
    alignas(64) float depth[kLanes];
    store(depth, median_depth(transmittance[b], median_w[b]));
    for_each_pixel(
        in.width, in.height, left + kBlockSize * (b % 4), top + kBlockSize * (b / 4),
        [&](int lane, size_t pixel) { image.depth[pixel * image.depth_stride] = depth[lane]; });
  }
}

inline void raster_tile(const RasterInput& in, const Image& image, const StageWriter* record,
                        int tile) {
  if (!image.alpha) return seek_tile(in, image, tile);
  if (image.depth && image.depth_mode == DepthMode::kMedian) {
    image.color ? raster_tile_channels<true, false, true>(in, image, record, tile)
                : raster_tile_channels<false, false, true>(in, image, record, tile);
  } else if (image.color && image.depth) {
    raster_tile_channels<true, true, false>(in, image, record, tile);
  } else if (image.color) {
    raster_tile_channels<true, false, false>(in, image, record, tile);
  } else {
    raster_tile_channels<false, true, false>(in, image, record, tile);
  }
}

}  // namespace splatpilot::SIMD_LEVEL
