// Alpha compositing of one tile, front to back, 16 pixels at a time.
#pragma once

#include "mathematics.hpp"
#include "types.hpp"

namespace flysplat::FLYSPLAT_LEVEL {

constexpr int kStageSize = 256;  // splats of a tile held at a time
constexpr int kStageWords = kStageSize / 64;

// A splat in the tile's own coordinates: u = ux x + uy y + u0, v = vy y + v0.
struct StagedSplat {
  float ux, uy, u0, vy, v0, log2_opacity;
  float red, green, blue, depth;
};

// Running sums of the 16 pixels of a block. Transmittance never grows, so a pixel whose next value
// would not exceed the limit is finished for good: that one comparison takes the place of a mask
// carried from splat to splat. Pixels outside the image start at 0, finished.
struct BlockState {
  F16 transmittance, red, green, blue, depth, alpha;
};

struct alignas(64) StagedTile {
  StagedSplat splats[kStageSize];
  uint64_t touching[kBlocksPerTile][kStageWords];  // bit i: splat i touches the block
};

// From the blocks that each of `count` splats touches to the splats that touch each block. Bits are
// transposed 16 splats at a time: one shifted into the sign shows in the lane bits. `blocks` has
// room for a multiple of 64.
FS_INLINE void transpose_blocks(int32_t* blocks, int count,
                                uint64_t touching[kBlocksPerTile][kStageWords]) {
  for (int i = count; i < (count + 63) / 64 * 64; ++i) blocks[i] = 0;
  for (int word = 0; word < (count + 63) / 64; ++word) {
    for (int b = 0; b < kBlocksPerTile; ++b) touching[b][word] = 0;
    for (int part = 0; part < 4; ++part) {
      const I16 pack = load(blocks + 64 * word + kLanes * part);
      for (int b = 0; b < kBlocksPerTile; ++b) {
        const uint64_t bits = sign_bits(shift_left(pack, 31 - b));
        touching[b][word] |= bits << (kLanes * part);
      }
    }
  }
}

FS_INLINE void stage(const RasterInput& in, uint32_t begin, uint32_t end, float left, float top,
                     StagedTile& staged) {
  alignas(64) int32_t blocks[kStageSize];
  const int count = static_cast<int>(end - begin);
  for (int i = 0; i < count; ++i) {
    const Pair* pair = in.pairs + begin + i;
    if (i + kPrefetchAhead < count) __builtin_prefetch(in.splats + pair[kPrefetchAhead].splat);
    const Splat& s = in.splats[pair->splat];
    const float x = s.mean_x - left, y = s.mean_y - top;
    staged.splats[i] = {s.ux, s.uy, -(s.ux * x + s.uy * y), s.vy, -(s.vy * y),
                        s.log2_opacity, s.color[0], s.color[1], s.color[2], s.depth};
    blocks[i] = static_cast<int32_t>(pair->blocks);
  }
  transpose_blocks(blocks, count, staged.touching);
}

// Composites the staged splats of one block; returns whether any pixel is still open.
template <bool kColor, bool kDepth>
FS_INLINE bool composite(const StagedTile& staged, int words, int b, const F16& x, const F16& y,
                         BlockState& state) {
  BlockState s = state;
  bool open = true;
  for (int word = 0; word < words && open; ++word) {
    for (uint64_t bits = staged.touching[b][word]; bits; bits &= bits - 1) {
      const StagedSplat& splat = staged.splats[64 * word + __builtin_ctzll(bits)];
      const F16 u = F16(splat.ux) * x + (F16(splat.uy) * y + F16(splat.u0));
      const F16 v = F16(splat.vy) * y + F16(splat.v0);
      const F16 exponent = (F16(splat.log2_opacity) - u * u) - v * v;
      const F16 alpha =
          zero_unless(exponent >= F16(kLog2AlphaCut), min(exp2(exponent), F16(kMaxAlpha)));
      const F16 rest = s.transmittance * (F16(1.0f) - alpha);
      const Mask16 keep = rest > F16(kMinTransmittance);
      const F16 weight = zero_unless(keep, s.transmittance * alpha);
      s.transmittance = rest;
      s.alpha += weight;
      if constexpr (kColor) {
        s.red += weight * F16(splat.red);
        s.green += weight * F16(splat.green);
        s.blue += weight * F16(splat.blue);
      }
      if constexpr (kDepth) s.depth += weight * F16(splat.depth);
      if (!any(keep)) {
        open = false;
        break;
      }
    }
  }
  state = s;
  return open;
}

// The pixels of one block of the image, ready to be written.
struct BlockPixels {
  alignas(64) float red[kLanes], green[kLanes], blue[kLanes], depth[kLanes], alpha[kLanes];
};

template <bool kColor, bool kDepth>
FS_INLINE void finish_block(const Image& image, const BlockState& state, BlockPixels& pixels) {
  store(pixels.alpha, state.alpha);
  if constexpr (kColor) {
    const F16 rest = F16(1.0f) - state.alpha;
    store(pixels.red, state.red + rest * F16(image.background[0]));
    store(pixels.green, state.green + rest * F16(image.background[1]));
    store(pixels.blue, state.blue + rest * F16(image.background[2]));
  }
  if constexpr (kDepth) {
    store(pixels.depth,
          image.expected_depth ? state.depth / max(state.alpha, F16(1e-10f)) : state.depth);
  }
}

// Writes the first `columns` pixels of a row of a block; `lane` is the row's first lane.
template <bool kColor, bool kDepth>
FS_INLINE void write_row(const Image& image, const BlockPixels& pixels, int lane, size_t pixel,
                         int columns) {
  for (int i = 0; i < columns; ++i) {
    image.alpha[pixel + i] = pixels.alpha[lane + i];
    if constexpr (kColor) {
      float* color = image.color + (pixel + i) * image.color_stride;
      color[0] = pixels.red[lane + i];
      color[1] = pixels.green[lane + i];
      color[2] = pixels.blue[lane + i];
    }
    if constexpr (kDepth) image.depth[(pixel + i) * image.depth_stride] = pixels.depth[lane + i];
  }
}

template <bool kColor, bool kDepth>
FS_INLINE void write_block(const Image& image, const BlockState& state, int width, int height,
                           int left, int top) {
  BlockPixels pixels;
  finish_block<kColor, kDepth>(image, state, pixels);
  const int columns = width - left < kBlockSize ? width - left : kBlockSize;
  const int rows = height - top < kBlockSize ? height - top : kBlockSize;
  size_t pixel = static_cast<size_t>(top) * static_cast<size_t>(width) + static_cast<size_t>(left);
  for (int row = 0; row < rows; ++row, pixel += static_cast<size_t>(width)) {
    const int lane = kBlockSize * row;
    if (columns == kBlockSize) {
      write_row<kColor, kDepth>(image, pixels, lane, pixel, kBlockSize);
    } else {
      write_row<kColor, kDepth>(image, pixels, lane, pixel, columns);
    }
  }
}

template <bool kColor, bool kDepth>
void raster_tile_channels(const RasterInput& in, int tile) {
  const int left = tile % in.tiles_x * kTileSize, top = tile / in.tiles_x * kTileSize;
  alignas(64) float lane_x[kLanes], lane_y[kLanes];
  for (int lane = 0; lane < kLanes; ++lane) {
    lane_x[lane] = static_cast<float>(lane % kBlockSize) + 0.5f;
    lane_y[lane] = static_cast<float>(lane / kBlockSize) + 0.5f;
  }

  BlockState state[kBlocksPerTile];
  uint32_t inside = 0;
  for (int b = 0; b < kBlocksPerTile; ++b) {
    const int columns = in.width - left - kBlockSize * (b % 4);
    const int rows = in.height - top - kBlockSize * (b / 4);
    const F16 one = F16(1.0f), zero = F16(0.0f);
    const Mask16 pixels = (load(lane_x) < F16(static_cast<float>(columns))) &
                          (load(lane_y) < F16(static_cast<float>(rows)));
    state[b] = {zero_unless(pixels, one), zero, zero, zero, zero, zero};
    if (columns > 0 && rows > 0) inside |= 1u << b;
  }

  StagedTile staged;
  uint32_t live = inside;
  const uint32_t end = in.tile_offsets[tile + 1];
  for (uint32_t begin = in.tile_offsets[tile]; begin < end && live; begin += kStageSize) {
    const int count = end - begin < kStageSize ? static_cast<int>(end - begin) : kStageSize;
    stage(in, begin, begin + count, static_cast<float>(left), static_cast<float>(top), staged);
    for (uint32_t bits = live; bits; bits &= bits - 1) {
      const int b = __builtin_ctz(bits);
      const F16 x = load(lane_x) + F16(static_cast<float>(kBlockSize * (b % 4)));
      const F16 y = load(lane_y) + F16(static_cast<float>(kBlockSize * (b / 4)));
      const bool open =
          composite<kColor, kDepth>(staged, (count + 63) / 64, b, x, y, state[b]);
      if (!open) live &= ~(1u << b);
    }
  }
  for (uint32_t bits = inside; bits; bits &= bits - 1) {
    const int b = __builtin_ctz(bits);
    write_block<kColor, kDepth>(in.image, state[b], in.width, in.height,
                                left + kBlockSize * (b % 4), top + kBlockSize * (b / 4));
  }
}

inline void raster_tile(const RasterInput& in, int tile) {
  if (in.image.color && in.image.depth) {
    raster_tile_channels<true, true>(in, tile);
  } else if (in.image.color) {
    raster_tile_channels<true, false>(in, tile);
  } else {
    raster_tile_channels<false, true>(in, tile);
  }
}

}  // namespace flysplat::FLYSPLAT_LEVEL
