// A tile: its splats and planes, staged in its own coordinates, and its blocks of 16 pixels.
#pragma once

#include "core/mathematics.hpp"
#include "core/types.hpp"

namespace splatpilot::SIMD_LEVEL {

// A splat in the tile's own coordinates: u = ux x + uy y + u0, v = vy y + v0.
struct StagedSplat {
  float ux, uy, u0, vy, v0, log2_opacity;
  float red, green, blue, depth;
};

// A DepthPlane in the tile's own coordinates.
struct StagedPlane {
  float ux, uy, u0, vy, v0;
  float w_x, w_y, w, mean_w;
};

SP_INLINE StagedSplat in_tile(const Splat& s, float left, float top) {
  const float x = s.mean_x - left, y = s.mean_y - top;
  return {s.ux,       s.uy,        -(s.ux * x + s.uy * y),
          s.vy,       -(s.vy * y), s.log2_opacity,
          s.color[0], s.color[1],  s.color[2],
          s.depth};
}

SP_INLINE StagedPlane in_tile(const DepthPlane& p, const Splat& s, float left, float top) {
  const float x = s.mean_x - left, y = s.mean_y - top;
  return {p.ux,  p.uy,  -(p.ux * x + p.uy * y),        p.vy, -(p.vy * y),
          p.w_x, p.w_y, p.w - (p.w_x * x + p.w_y * y), p.w};
}

SP_INLINE F16 alpha_at(const StagedSplat& splat, const F16& x, const F16& y) {
  const F16 u = F16(splat.ux) * x + (F16(splat.uy) * y + F16(splat.u0));
  const F16 v = F16(splat.vy) * y + F16(splat.v0);
  const F16 exponent = (F16(splat.log2_opacity) - u * u) - v * v;
  return zero_unless(exponent >= F16(kLog2AlphaCut), min(exp2(exponent), F16(kMaxAlpha)));
}

// Multiplies transmittances by that of one splat without blur; returns whether any is above one
// half. Those above one half before take the splat's inverse depth.
SP_INLINE bool seek_median(const StagedPlane& plane, float log2_opacity, const F16& x, const F16& y,
                           F16& transmittance, F16& median_w) {
  const F16 half = F16(0.5f);
  const F16 w = F16(plane.w_x) * x + (F16(plane.w_y) * y + F16(plane.w));
  const F16 u = F16(plane.ux) * x + (F16(plane.uy) * y + F16(plane.u0));
  const F16 v = F16(plane.vy) * y + F16(plane.v0);
  const F16 divisor = min(w, F16(plane.mean_w));
  const F16 exponent = F16(log2_opacity) - (u * u + v * v) / (divisor * divisor);
  const F16 alpha = zero_unless(exponent >= F16(kLog2AlphaCut), exp2(exponent));
  median_w = select(transmittance > half, w, median_w);
  transmittance = transmittance - transmittance * alpha;
  return any(transmittance > half);
}

constexpr int kStageWords = kStageSize / 64;

struct alignas(64) StagedTile {
  StagedSplat splats[kStageSize + 1];  // the last is transparent
  StagedPlane planes[kStageSize + 1];
  uint64_t touching[kBlocksPerTile][kStageWords];  // bit i: splat i touches the block
};

// Splats whose opacities are computed together, since they do not depend on each other.
constexpr int kGroupSize = 4;

// Iterates over the staged splats that touch a block, in order.
class TouchingSplats {
 public:
  SP_INLINE TouchingSplats(const StagedTile& staged, int words, int b)
      : touching_(staged.touching[b]), words_(words), bits_(touching_[0]) {}

  // Writes the indices of the next ones, padded with that of the transparent splat; returns false
  // at the end.
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

// Transposes the blocks that each of `count` splats touches to the splats that touch each block, 16
// splats at a time. `blocks` has space for a multiple of 64.
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

// Stages `count` splats, and their planes if `planes`.
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
    if (planes) staged.planes[i] = in_tile(in.planes[pair->splat], splat, left, top);
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
    if (columns == kBlockSize) {  // a constant length for the compiler
      for (int i = 0; i < kBlockSize; ++i) visit(lane + i, pixel + static_cast<size_t>(i));
    } else {
      for (int i = 0; i < columns; ++i) visit(lane + i, pixel + static_cast<size_t>(i));
    }
  }
}

// Composites a tile front to back. begin(b, open) starts a block, with open 1 at pixels of the
// image, else 0; stage(first, count, left, top) stages pairs; draw(b, first, words, pixel)
// composites them in one block and returns whether a pixel is still open; write(b, left, top) ends
// it.
template <typename Input, typename Begin, typename Stage, typename Draw, typename Write>
SP_INLINE void composite_tile(const Input& in, int tile, const Begin& begin, const Stage& stage,
                              const Draw& draw, const Write& write) {
  const int left = tile % in.tiles_x * kTileSize, top = tile / in.tiles_x * kTileSize;
  const LaneCenters centers = lane_centers();
  uint32_t inside = 0;
  for (int b = 0; b < kBlocksPerTile; ++b) {
    const F16 open = ones_inside(in.width, in.height, centers, left, top, b);
    begin(b, open);
    if (any(open > F16(0.0f))) inside |= 1u << b;
  }
  uint32_t live = inside;
  const size_t end = in.tile_offsets[tile + 1];
  for (size_t first = in.tile_offsets[tile]; first < end && live; first += kStageSize) {
    const int count = end - first < kStageSize ? static_cast<int>(end - first) : kStageSize;
    stage(first, count, static_cast<float>(left), static_cast<float>(top));
    for (uint32_t bits = live; bits; bits &= bits - 1) {
      const int b = __builtin_ctz(bits);
      if (!draw(b, first, (count + 63) / 64, block_centers(centers, b))) live &= ~(1u << b);
    }
  }
  for (uint32_t bits = inside; bits; bits &= bits - 1) {
    const int b = __builtin_ctz(bits);
    write(b, left + kBlockSize * (b % 4), top + kBlockSize * (b / 4));
  }
}

}  // namespace splatpilot::SIMD_LEVEL
