// A tile: its splats, staged, and its blocks of 16 pixels.
#pragma once

#include "core/mathematics.hpp"
#include "core/types.hpp"
#include "project/footprints.hpp"

namespace splatpilot::SIMD_LEVEL {

constexpr int kStageWords = kStageSize / 64;

struct alignas(64) StagedTile {
  StagedSplat splats[kStageSize + 1];  // the last shows nothing
  StagedPlane planes[kStageSize + 1];
  uint64_t touching[kBlocksPerTile][kStageWords];  // bit i: splat i touches the block
};

// Splats whose opacities are found before the first of them is composited: each takes long and
// waits for none of the others.
constexpr int kGroupSize = 4;

// Goes through the staged splats that touch a block, in order.
class TouchingSplats {
 public:
  SP_INLINE TouchingSplats(const StagedTile& staged, int words, int b)
      : touching_(staged.touching[b]), words_(words), bits_(touching_[0]) {}

  // Indices of the next; where there are fewer, for the rest that of the splat that shows nothing.
  // Returns whether there were any.
  SP_INLINE bool next(int (&indices)[kGroupSize]) {
    SP_EACH_OF(kGroupSize, n) {
      while (!bits_ && word_ + 1 < words_) bits_ = touching_[++word_];
      indices[n] = bits_ ? 64 * word_ + __builtin_ctzll(bits_) : kStageSize;
      bits_ &= bits_ - 1;
    }
    return indices[0] != kStageSize;
  }

 private:
  const uint64_t* touching_;
  int words_, word_ = 0;
  uint64_t bits_;
};

// From the blocks that each of `count` splats touches to the splats that touch each block. Bits are
// transposed 16 splats at a time: one shifted into the sign shows in the lane bits. `blocks` has
// room for a multiple of 64.
SP_INLINE void transpose_blocks(int32_t* blocks, int count,
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

// With `planes`, of these too.
SP_INLINE void stage(const RasterInput& in, bool planes, size_t begin, int count, float left,
                     float top, StagedTile& staged) {
  alignas(64) int32_t blocks[kStageSize];
  staged.splats[kStageSize] = {};
  staged.splats[kStageSize].log2_opacity = 2.0f * kLog2AlphaCut;
  staged.planes[kStageSize] = {};
  staged.planes[kStageSize].w = staged.planes[kStageSize].mean_w = 1.0f;
  for (int i = 0; i < count; ++i) {
    const Pair* pair = in.pairs + begin + i;
    if (i + kPrefetchAhead < count) {
      __builtin_prefetch(in.splats + pair[kPrefetchAhead].splat);
      if (planes) __builtin_prefetch(in.planes + pair[kPrefetchAhead].splat);
    }
    const Splat& splat = in.splats[pair->splat];
    staged.splats[i] = in_tile(splat, left, top);
    if (planes) {
      staged.planes[i] = in_tile(in.planes[pair->splat], splat, left, top);
    }
    blocks[i] = static_cast<int32_t>(pair->blocks);
  }
  transpose_blocks(blocks, count, staged.touching);
}

// Pixel centers of the 16 lanes of a block, from its corner.
struct LaneCenters {
  F16 x, y;
};

SP_INLINE LaneCenters lane_centers() {
  alignas(64) float x[kLanes], y[kLanes];
  for (int lane = 0; lane < kLanes; ++lane) {
    x[lane] = static_cast<float>(lane % kBlockSize) + 0.5f;
    y[lane] = static_cast<float>(lane / kBlockSize) + 0.5f;
  }
  return {load(x), load(y)};
}

// The same of block b of a tile, from the tile's corner.
SP_INLINE LaneCenters block_centers(const LaneCenters& centers, int b) {
  return {centers.x + F16(static_cast<float>(kBlockSize * (b % 4))),
          centers.y + F16(static_cast<float>(kBlockSize * (b / 4)))};
}

// 1 for pixels of block b of the tile that lie inside the image, else 0.
SP_INLINE F16 ones_inside(int width, int height, const LaneCenters& centers, int left, int top,
                          int b) {
  const int columns = width - left - kBlockSize * (b % 4);
  const int rows = height - top - kBlockSize * (b / 4);
  return zero_unless(
      (centers.x < F16(static_cast<float>(columns))) & (centers.y < F16(static_cast<float>(rows))),
      F16(1.0f));
}

// Calls visit(lane, pixel) for the pixels of a block that are on the image.
template <typename Visit>
SP_INLINE void for_each_pixel(int width, int height, int left, int top, const Visit& visit) {
  const int columns = width - left < kBlockSize ? width - left : kBlockSize;
  const int rows = height - top < kBlockSize ? height - top : kBlockSize;
  size_t pixel = static_cast<size_t>(top) * static_cast<size_t>(width) + static_cast<size_t>(left);
  for (int row = 0; row < rows; ++row, pixel += static_cast<size_t>(width)) {
    const int lane = kBlockSize * row;
    if (columns == kBlockSize) {  // of a length that the compiler knows
      for (int i = 0; i < kBlockSize; ++i) visit(lane + i, pixel + static_cast<size_t>(i));
    } else {
      for (int i = 0; i < columns; ++i) visit(lane + i, pixel + static_cast<size_t>(i));
    }
  }
}

}  // namespace splatpilot::SIMD_LEVEL
