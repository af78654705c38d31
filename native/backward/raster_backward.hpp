// The derivative of raster.hpp: one tile, back to front, 16 pixels at a time.
//
// With w_i = T_i alpha_i and s_i = dL/d(color, depth, alpha) . (color_i, depth_i, 1), dL/dalpha_i
// is T_i (s_i - B_i), where B_i = alpha_{i+1} s_{i+1} + (1 - alpha_{i+1}) B_{i+1} shows behind
// splat i.
#pragma once

#include "raster/raster.hpp"

namespace splatpilot::SIMD_LEVEL {

// The effect of one splat on one block; zero where a pixel was finished.
struct BlockRecord {
  F16 alpha, weight;
};

struct BlockBackward {
  LaneCenters pixel;
  F16 transmittance;
  F16 red, green, blue, depth, alpha;  // dL/d(pixel)
  F16 behind;
};

struct alignas(64) BackwardScratch {
  BlockBackward blocks[kBlocksPerTile];
  BlockRecord records[kStageSize * kBlocksPerTile];
  StagedSplat splats[kStageSize];
  uint32_t touched[kStageSize];  // blocks with a record
};
static_assert(sizeof(BackwardScratch) <= kBackwardScratchBytes);

// Pixels outside the image get zeros.
SP_INLINE F16 load_pixels(const float* values, int stride, const RasterInput& in, int left,
                          int top) {
  alignas(64) float pixels[kLanes] = {};
  for_each_pixel(in.width, in.height, left, top, [&](int lane, size_t pixel) {
    pixels[lane] = values[pixel * static_cast<size_t>(stride)];
  });
  return load(pixels);
}

template <bool kColor, bool kDepth>
SP_INLINE void load_block(const RasterInput& in, const ImageGradient& g, int left, int top,
                          BlockBackward& block) {
  block.alpha = load_pixels(g.alpha, 1, in, left, top);
  if constexpr (kColor) {
    block.red = load_pixels(g.color, g.stride, in, left, top);
    block.green = load_pixels(g.color + 1, g.stride, in, left, top);
    block.blue = load_pixels(g.color + 2, g.stride, in, left, top);
    block.alpha =
        block.alpha - (block.red * F16(g.background[0]) +
                       (block.green * F16(g.background[1]) + block.blue * F16(g.background[2])));
  }
  if constexpr (kDepth) {
    block.depth = load_pixels(g.depth, g.stride, in, left, top);
    if (g.expected_depth) {
      // Alpha is 0 or at least 1/255; where it is 0 no splat takes the gradient.
      const F16 alpha = load_pixels(g.rendered_alpha, 1, in, left, top);
      block.depth = block.depth / max(alpha, F16(0.5f * kAlphaCut));
      block.alpha =
          block.alpha - block.depth * load_pixels(g.expected_depth, g.stride, in, left, top);
    }
  }
  block.behind = F16(0.0f);
}

// Composites `count` staged splats again from block.transmittance on and records them; returns one
// past the last record.
SP_INLINE BlockRecord* replay(BackwardScratch& s, const Pair* pairs, int count, uint32_t live) {
  BlockRecord* record = s.records;
  for (int i = 0; i < count; ++i) {
    const StagedSplat& splat = s.splats[i];
    uint32_t touched = pairs[i].blocks & live;
    for (uint32_t bits = touched; bits; bits &= bits - 1) {
      const int b = __builtin_ctz(bits);
      BlockBackward& block = s.blocks[b];
      const F16 alpha = alpha_at(splat, block.pixel.x, block.pixel.y);
      const F16 transmittance = block.transmittance;
      const F16 rest = transmittance * (F16(1.0f) - alpha);
      const Mask16 keep = rest > F16(kMinTransmittance);
      if (!any(keep)) {
        live &= ~(1u << b);
        touched &= ~(1u << b);
        continue;
      }
      block.transmittance = rest;
      record->alpha = zero_unless(keep, alpha);
      record->weight = zero_unless(keep, transmittance * alpha);
      ++record;
    }
    s.touched[i] = touched;
  }
  return record;
}

// One register at a time, so that the sums stay in registers at every SIMD level.
template <bool kColor, bool kDepth>
SP_INLINE void backward_pair(const StagedSplat& splat, uint32_t touched, const BlockRecord* record,
                             BlockBackward* blocks, PairGradient& gradient) {
  Register sums[16] = {};
  for (uint32_t bits = touched; bits; bits &= bits - 1, ++record) {
    BlockBackward& block = blocks[__builtin_ctz(bits)];
    SP_EACH_REGISTER(k) {
      const Register x = block.pixel.x.r[k], y = block.pixel.y.r[k];
      const Register alpha = record->alpha.r[k], weight = record->weight.r[k];
      const Register behind = block.behind.r[k];
      const Register u = splat.ux * x + (splat.uy * y + splat.u0);
      const Register v = splat.vy * y + splat.v0;
      Register shown = block.alpha.r[k];
      if constexpr (kColor) {
        const Register red = block.red.r[k], green = block.green.r[k], blue = block.blue.r[k];
        shown = shown + red * splat.red + green * splat.green + blue * splat.blue;
        sums[6] += weight * red;
        sums[7] += weight * green;
        sums[8] += weight * blue;
      }
      if constexpr (kDepth) {
        const Register depth = block.depth.r[k];
        shown = shown + depth * splat.depth;
        sums[9] += weight * depth;
      }
      const Register difference = shown - behind;
      block.behind.r[k] = behind + alpha * difference;
      // Where alpha is capped it does not change with the exponent.
      const Register h = alpha < kMaxAlpha ? weight * difference : Register{};
      const Register hu = h * u, hv = h * v;
      sums[0] += h;
      sums[1] += hu;
      sums[2] += hv;
      sums[3] += hu * u;
      sums[4] += hu * v;
      sums[5] += hv * v;
    }
  }
  sum_lanes(sums, gradient.sums);
}

template <bool kColor, bool kDepth>
void raster_tile_backward_channels(const RasterInput& in, const StageReader& record,
                                   const ImageGradient& g, int tile, BackwardScratch& s,
                                   PairGradient* gradients) {
  const int left = tile % in.tiles_x * kTileSize, top = tile / in.tiles_x * kTileSize;
  const size_t first = in.tile_offsets[tile], last = in.tile_offsets[tile + 1];
  const size_t stages = record.stages_done[tile];
  const LaneCenters centers = lane_centers();
  F16 inside[kBlocksPerTile];
  for (int b = 0; b < kBlocksPerTile; ++b) {
    const int block_left = kBlockSize * (b % 4), block_top = kBlockSize * (b / 4);
    inside[b] = ones_inside(in.width, in.height, centers, left, top, b);
    s.blocks[b].pixel = block_centers(centers, b);
    load_block<kColor, kDepth>(in, g, left + block_left, top + block_top, s.blocks[b]);
  }

  const size_t reached = first + stages * kStageSize < last ? first + stages * kStageSize : last;
  for (size_t slot = reached; slot < last; ++slot) gradients[slot] = {};
  for (size_t stage = stages; stage-- > 0;) {
    const size_t begin = first + stage * kStageSize;
    const int count = static_cast<int>(last - begin < kStageSize ? last - begin : kStageSize);
    for (int i = 0; i < count; ++i) {
      const Pair* pair = in.pairs + begin + i;
      if (i + kPrefetchAhead < count) __builtin_prefetch(in.splats + pair[kPrefetchAhead].splat);
      s.splats[i] =
          in_tile(in.splats[pair->splat], static_cast<float>(left), static_cast<float>(top));
    }
    uint32_t live = 0;
    for (int b = 0; b < kBlocksPerTile; ++b) {
      const size_t saved = stage ? record.later_stages[tile] + stage - 1 : 0;
      s.blocks[b].transmittance =
          stage ? load(record.transmittance + (saved * kBlocksPerTile + b) * kLanes) : inside[b];
      if (any(s.blocks[b].transmittance > F16(kMinTransmittance))) live |= 1u << b;
    }
    const BlockRecord* block_record = replay(s, in.pairs + begin, count, live);
    for (int i = count; i-- > 0;) {
      block_record -= __builtin_popcount(s.touched[i]);
      backward_pair<kColor, kDepth>(s.splats[i], s.touched[i], block_record, s.blocks,
                                    gradients[begin + i]);
    }
  }
}

inline void raster_tile_backward(const RasterInput& in, const StageReader& record,
                                 const ImageGradient& g, int tile, void* scratch,
                                 PairGradient* gradients) {
  BackwardScratch& s = *static_cast<BackwardScratch*>(scratch);
  if (!g.depth)
    return raster_tile_backward_channels<true, false>(in, record, g, tile, s, gradients);
  if (!g.color)
    return raster_tile_backward_channels<false, true>(in, record, g, tile, s, gradients);
  raster_tile_backward_channels<true, true>(in, record, g, tile, s, gradients);
}

// Adds up each splat's pairs, tile after tile, and turns sums over u and v into gradients.
inline void sum_pairs(const Splat* splats, size_t count, const PairRange* ranges,
                      const uint32_t* slots, const PairGradient* pairs, SplatGradient* gradients) {
  const float two_ln2 = 1.3862943611f;  // the exponent is in base 2
  for (size_t i = 0; i < count; ++i) {
    if (i + 3 * kPrefetchAhead < count) {
      __builtin_prefetch(slots + ranges[i + 3 * kPrefetchAhead].begin);
    }
    if (i + kPrefetchAhead < count) {
      const PairRange& next = ranges[i + kPrefetchAhead];
      for (uint32_t k = next.begin; k < next.end && k < next.begin + 4; ++k) {
        __builtin_prefetch(pairs + slots[k]);
      }
    }
    F16 total = F16(0.0f);
    for (uint32_t k = ranges[i].begin; k < ranges[i].end; ++k) total += load(pairs[slots[k]].sums);
    alignas(64) float t[kLanes];
    store(t, total);
    const Splat& s = splats[i];
    gradients[i] = {{two_ln2 * (s.ux * t[1]), two_ln2 * (s.uy * t[1] + s.vy * t[2])},
                    t[0],
                    t[3],
                    t[4],
                    t[5],
                    {t[6], t[7], t[8]},
                    t[9],
                    {}};
  }
}

}  // namespace splatpilot::SIMD_LEVEL
