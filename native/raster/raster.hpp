// Alpha compositing of one tile, front to back, 16 pixels at a time.
#pragma once

#include "raster/tile_blocks.hpp"

namespace splatpilot::SIMD_LEVEL {

// Running sums of the 16 pixels of a block. A pixel is finished once its transmittance would not
// exceed the limit; it never grows again. Pixels outside the image start at 0, finished.
struct BlockState {
  F16 transmittance, red, green, blue, depth, alpha;
  // Transmittance of footprints without blur, and the inverse depth at which it fell to one half.
  F16 sharp_transmittance, median_w;
};

// Composites the staged splats of one block; returns whether any pixel is still open. A pixel with
// a finished color is open until it has a median depth.
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
      s.transmittance = max(s.transmittance, F16(1e-20f));  // never a subnormal number
    }
  }
  state = s;
  return open;
}

// The pixels of one block of the image, ready to be written.
struct BlockPixels {
  alignas(64) float red[kLanes], green[kLanes], blue[kLanes], depth[kLanes], alpha[kLanes];
};

// z at the inverse depth where transmittance fell to one half; 0 if it did not.
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
  BlockState state[kBlocksPerTile];
  StagedTile staged;
  uint32_t seeking = 0;  // blocks with pixels that have no median yet
  uint32_t stages = 0;
  composite_tile(
      in, tile,
      [&](int b, const F16& open) {
        const F16 zero = F16(0.0f);
        state[b] = {open, zero, zero, zero, zero, zero, open, zero};
        if (kMedian && any(open > zero)) seeking |= 1u << b;
      },
      [&](size_t first, int count, float left, float top) {
        if (record && stages > 0) {
          const size_t saved = record->later_stages[tile] + stages - 1;
          float* transmittance = record->transmittance + saved * kTileSize * kTileSize;
          for (int b = 0; b < kBlocksPerTile; ++b) {
            store(transmittance + kLanes * b, state[b].transmittance);
          }
        }
        ++stages;
        stage(in, seeking != 0, first, count, left, top, staged);
      },
      [&](int b, size_t, int words, const LaneCenters& pixel) {
        const bool seeks = kMedian && (seeking >> b & 1);
        const bool open =
            seeks ? composite<kColor, kDepth, kMedian>(staged, words, b, pixel, state[b])
                  : composite<kColor, kDepth, false>(staged, words, b, pixel, state[b]);
        if (seeks && !any(state[b].sharp_transmittance > F16(0.5f))) seeking &= ~(1u << b);
        return open;
      },
      [&](int b, int left, int top) {
        write_block<kColor, kDepth, kMedian>(image, state[b], in.width, in.height, left, top);
      });
  if (record) record->stages_done[tile] = stages;
}

// Seeks the median depth of one block among the staged splats; returns whether a pixel has none.
SP_INLINE bool seek_median_of_block(const StagedTile& staged, int words, int b,
                                    const LaneCenters& pixel, F16& transmittance, F16& median_w) {
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

// The median depth of one tile alone, bitwise identical to that of `raster_tile_channels`.
inline void raster_median_depth(const RasterInput& in, const Image& image, int tile) {
  F16 transmittance[kBlocksPerTile], median_w[kBlocksPerTile];
  StagedTile staged;
  composite_tile(
      in, tile,
      [&](int b, const F16& open) {
        transmittance[b] = open;
        median_w[b] = F16(0.0f);
      },
      [&](size_t first, int count, float left, float top) {
        stage(in, true, first, count, left, top, staged);
      },
      [&](int b, size_t, int words, const LaneCenters& pixel) {
        return seek_median_of_block(staged, words, b, pixel, transmittance[b], median_w[b]);
      },
      [&](int b, int left, int top) {
        alignas(64) float depth[kLanes];
        store(depth, median_depth(transmittance[b], median_w[b]));
        for_each_pixel(in.width, in.height, left, top, [&](int lane, size_t pixel) {
          image.depth[pixel * image.depth_stride] = depth[lane];
        });
      });
}

inline void raster_tile(const RasterInput& in, const Image& image, const StageWriter* record,
                        int tile) {
  if (!image.alpha) return raster_median_depth(in, image, tile);
  const bool color = image.color, median = image.depth && image.depth_mode == DepthMode::kMedian;
  if (median && color) return raster_tile_channels<true, false, true>(in, image, record, tile);
  if (median) return raster_tile_channels<false, false, true>(in, image, record, tile);
  if (color && image.depth) return raster_tile_channels<true, true, false>(in, image, record, tile);
  if (color) return raster_tile_channels<true, false, false>(in, image, record, tile);
  raster_tile_channels<false, true, false>(in, image, record, tile);
}

}  // namespace splatpilot::SIMD_LEVEL
