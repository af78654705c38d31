// Compositing of the surfels of one tile, front to back, 16 pixels at a time, and its derivatives.
#pragma once

#include "raster/tile_blocks.hpp"
#include "surfels/surfel_types.hpp"

namespace splatpilot::SIMD_LEVEL {

struct alignas(64) StagedSurfels {
  Surfel surfels[kStageSize];  // with means relative to the tile
  uint64_t touching[kBlocksPerTile][kStageWords];
};

SP_INLINE void stage_surfels(const SurfelRasterInput& in, size_t begin, int count, float left,
                             float top, StagedSurfels& staged) {
  alignas(64) int32_t blocks[kStageSize];
  for (int i = 0; i < count; ++i) {
    const Pair* pair = in.pairs + begin + i;
    if (i + kPrefetchAhead < count) __builtin_prefetch(in.surfels + pair[kPrefetchAhead].splat);
    Surfel& s = staged.surfels[i];
    s = in.surfels[pair->splat];
    s.mean[0] -= left;
    s.mean[1] -= top;
    blocks[i] = static_cast<int32_t>(pair->blocks);
  }
  transpose_blocks(blocks, count, staged.touching);
}

// A surfel at 16 pixels.
struct SurfelSample {
  F16 dx, dy;
  F16 U, V;    // u . d and v . d of the surfel
  F16 u, v;    // of the ray's intersection with the plane, in standard deviations
  F16 z;       // its depth
  Mask16 hit;  // lanes that show the plane; others show the blob
  F16 r2, depth;
  F16 alpha;  // 0 below the cut
};

// alpha = o exp(-r2 / 2): r2 is the smaller of u^2 + v^2 on the surfel's plane and of the blob's
// |d|^2 / kBlobVariance (the larger of the two Gaussians; Huang et al. 2024, equation 11).
SP_INLINE SurfelSample sample_surfel(const Surfel& s, const LaneCenters& pixel,
                                     const F16& near_plane) {
  SurfelSample a;
  a.dx = pixel.x - F16(s.mean[0]);
  a.dy = pixel.y - F16(s.mean[1]);
  a.z = F16(1.0f) / (F16(s.w[0]) * a.dx + (F16(s.w[1]) * a.dy + F16(s.w[2])));
  a.U = F16(s.u[0]) * a.dx + (F16(s.u[1]) * a.dy + F16(s.u[2]));
  a.V = F16(s.v[0]) * a.dx + (F16(s.v[1]) * a.dy + F16(s.v[2]));
  a.u = a.U * a.z;
  a.v = a.V * a.z;
  const F16 on_plane = a.u * a.u + a.v * a.v;
  const F16 of_blob = F16(1.0f / kBlobVariance) * (a.dx * a.dx + a.dy * a.dy);
  a.hit = (a.z >= near_plane) & (on_plane <= of_blob);
  a.r2 = select(a.hit, on_plane, of_blob);
  a.depth = select(a.hit, a.z, F16(s.depth));
  const F16 exponent = F16(s.log2_opacity) - F16(kHalfLog2e) * a.r2;
  a.alpha = zero_unless(exponent >= F16(kLog2AlphaCut), min(exp2(exponent), F16(kMaxAlpha)));
  return a;
}

struct SurfelBlockState {
  F16 transmittance;  // as in BlockState: it keeps the value that closed the pixel
  F16 color[3], normal[3], depth, alpha, median, distort;
  F16 last_transmittance, passed, median_index;  // for the backward pass
};

// Composites the staged surfels, from index `first` in the tile; returns whether any pixel is still
// open.
template <bool kDistort, bool kRecord>
SP_INLINE bool composite_surfels(const StagedSurfels& staged, int words, int b,
                                 const LaneCenters& pixel, float first, const F16& near_plane,
                                 SurfelBlockState& state) {
  SurfelBlockState s = state;
  bool open = true;
  for (int word = 0; word < words && open; ++word) {
    for (uint64_t bits = staged.touching[b][word]; bits; bits &= bits - 1) {
      const int i = 64 * word + __builtin_ctzll(bits);
      const Surfel& surfel = staged.surfels[i];
      const SurfelSample a = sample_surfel(surfel, pixel, near_plane);
      const F16 rest = s.transmittance * (F16(1.0f) - a.alpha);
      const Mask16 keep = rest > F16(kMinTransmittance);
      const F16 weight = zero_unless(keep, s.transmittance * a.alpha);
      const Mask16 is_median = (weight > F16(0.0f)) & (s.transmittance > F16(0.5f));
      s.median = select(is_median, a.depth, s.median);
      // sum_j w_j (z_i - z_j) over those in front; each enters both of the pair's terms.
      if constexpr (kDistort) s.distort += weight * (a.depth * s.alpha - s.depth);
      if constexpr (kRecord) {
        const F16 index = F16(first + static_cast<float>(i));
        s.median_index = select(is_median, index, s.median_index);
        s.last_transmittance = select(keep, rest, s.last_transmittance);
        s.passed = select(keep, index + F16(1.0f), s.passed);
      }
      s.transmittance = rest;
      s.alpha += weight;
      s.depth += weight * a.depth;
      for (int c = 0; c < 3; ++c) s.color[c] += weight * F16(surfel.color[c]);
      for (int c = 0; c < 3; ++c) s.normal[c] += weight * F16(surfel.normal[c]);
      if (!any(keep)) {
        open = false;
        break;
      }
    }
  }
  state = s;
  return open;
}

SP_INLINE void write_surfel_block(const SurfelImages<float>& out, const SurfelBlockState& s,
                                  int width, int height, int left, int top) {
  alignas(64) float lanes[10][kLanes];
  const F16* packs[10] = {s.color,      s.color + 1, s.color + 2, s.normal,  s.normal + 1,
                          s.normal + 2, &s.depth,    &s.alpha,    &s.median, &s.distort};
  for (int f = 0; f < 10; ++f) store(lanes[f], *packs[f]);
  for_each_pixel(width, height, left, top, [&](int lane, size_t pixel) {
    for (int c = 0; c < 3; ++c) out.color[3 * pixel + c] = lanes[c][lane];
    for (int c = 0; c < 3; ++c) out.normal[3 * pixel + c] = lanes[3 + c][lane];
    out.depth[pixel] = lanes[6][lane];
    out.alpha[pixel] = lanes[7][lane];
    out.median[pixel] = lanes[8][lane];
    // Both orders of a pair count.
    if (out.distort) out.distort[pixel] = 2.0f * lanes[9][lane];
  });
}

template <bool kDistort, bool kRecord>
void raster_surfel_tile(const SurfelRasterInput& in, const SurfelImages<float>& out,
                        SurfelBlockRecord* records, int tile) {
  const F16 zero = F16(0.0f), one = F16(1.0f), near_plane = F16(in.near_plane);
  SurfelBlockState state[kBlocksPerTile];
  StagedSurfels staged;
  composite_tile(
      in, tile,
      [&](int b, const F16& open) {
        state[b] = {open, {zero, zero, zero}, {zero, zero, zero}, zero, zero, zero, zero, one, zero,
                    -one};
      },
      [&](size_t first, int count, float left, float top) {
        stage_surfels(in, first, count, left, top, staged);
      },
      [&](int b, size_t first, int words, const LaneCenters& pixel) {
        const float index = static_cast<float>(first - in.tile_offsets[tile]);
        return composite_surfels<kDistort, kRecord>(staged, words, b, pixel, index, near_plane,
                                                    state[b]);
      },
      [&](int b, int left, int top) {
        const SurfelBlockState& s = state[b];
        write_surfel_block(out, s, in.width, in.height, left, top);
        if constexpr (kRecord) {
          SurfelBlockRecord& record = records[kBlocksPerTile * tile + b];
          store(record.transmittance, s.last_transmittance);
          store(record.passed, s.passed);
          store(record.median, s.median_index);
          store(record.alpha, s.alpha);
          store(record.depth, s.depth);
        }
      });
}

inline void raster_surfels(const SurfelRasterInput& in, const SurfelImages<float>& out,
                           SurfelBlockRecord* records, int tile) {
  if (out.distort && records) return raster_surfel_tile<true, true>(in, out, records, tile);
  if (out.distort) return raster_surfel_tile<true, false>(in, out, records, tile);
  if (records) return raster_surfel_tile<false, true>(in, out, records, tile);
  raster_surfel_tile<false, false>(in, out, records, tile);
}

// Back to front, surfel by surfel, over the blocks that each touches, so that sums over pixels are
// taken once per surfel and tile.

// Gradients of the loss with respect to the pixels of a block, and the running state.
struct BackwardBlock {
  F16 color[3], normal[3], depth, alpha, median, distort;
  F16 passed, median_index, all_alpha, all_depth;
  F16 transmittance;               // behind the current surfel
  F16 behind;                      // sum over surfels behind it of weight * gradient of weight
  F16 alpha_behind, depth_behind;  // sums of weights and of weighted depths
};

SP_INLINE BackwardBlock backward_block(const SurfelRasterInput& in,
                                       const SurfelImages<const float>& g,
                                       const SurfelBlockRecord& record, int left, int top) {
  alignas(64) float lanes[10][kLanes] = {};
  for_each_pixel(in.width, in.height, left, top, [&](int lane, size_t pixel) {
    for (int c = 0; c < 3; ++c) {
      if (g.color) lanes[c][lane] = g.color[3 * pixel + c];
      if (g.normal) lanes[3 + c][lane] = g.normal[3 * pixel + c];
    }
    if (g.depth) lanes[6][lane] = g.depth[pixel];
    if (g.alpha) lanes[7][lane] = g.alpha[pixel];
    if (g.median) lanes[8][lane] = g.median[pixel];
    if (g.distort) lanes[9][lane] = 2.0f * g.distort[pixel];
  });
  const F16 zero = F16(0.0f);
  return {{load(lanes[0]), load(lanes[1]), load(lanes[2])},
          {load(lanes[3]), load(lanes[4]), load(lanes[5])},
          load(lanes[6]),
          load(lanes[7]),
          load(lanes[8]),
          load(lanes[9]),
          load(record.passed),
          load(record.median),
          load(record.alpha),
          load(record.depth),
          load(record.transmittance),
          zero,
          zero,
          zero};
}

// Adds the gradient of a surfel over 16 pixels; fields as in SurfelGradient.
template <bool kDistort>
SP_INLINE void accumulate_surfel(const Surfel& surfel, const LaneCenters& pixel, const F16& index,
                                 const F16& near_plane, BackwardBlock& block, F16 sums[16]) {
  const F16 zero = F16(0.0f), one = F16(1.0f);
  const SurfelSample a = sample_surfel(surfel, pixel, near_plane);
  const Mask16 drawn = (a.alpha > zero) & (index < block.passed);
  if (!any(drawn)) return;
  const F16 inverse_rest = one / (one - a.alpha);
  const F16 transmittance = block.transmittance * inverse_rest;
  const F16 weight = zero_unless(drawn, transmittance * a.alpha);

  // With respect to the weight and the depth.
  F16 by_weight = block.alpha + block.depth * a.depth;
  F16 by_depth = block.depth;
  for (int c = 0; c < 3; ++c) by_weight += block.color[c] * F16(surfel.color[c]);
  for (int c = 0; c < 3; ++c) by_weight += block.normal[c] * F16(surfel.normal[c]);
  if constexpr (kDistort) {
    const F16 alpha_before = (block.all_alpha - block.alpha_behind) - weight;
    const F16 depth_before = (block.all_depth - block.depth_behind) - weight * a.depth;
    by_weight += block.distort * (a.depth * (alpha_before - block.alpha_behind) -
                                  (depth_before - block.depth_behind));
    by_depth += block.distort * (alpha_before - block.alpha_behind);
    block.alpha_behind += weight;
    block.depth_behind += weight * a.depth;
  }
  const Mask16 is_median = (index >= block.median_index) & (index <= block.median_index);
  by_depth = weight * by_depth + zero_unless(is_median, block.median);
  const F16 by_alpha = transmittance * by_weight - block.behind * inverse_rest;
  block.behind += weight * by_weight;
  block.transmittance = select(drawn, transmittance, block.transmittance);

  // alpha = exp(log o - r2 / 2) where it is not clamped.
  const F16 by_exponent = zero_unless(drawn & (a.alpha < F16(kMaxAlpha)), by_alpha * a.alpha);
  const F16 by_u = -(zero_unless(a.hit, by_exponent * a.u));
  const F16 by_v = -(zero_unless(a.hit, by_exponent * a.v));
  // u = z U and v = z V with U, V and q = 1 / z linear in the pixel, so dL/dq is
  // -z^2 (dL/dz + U dL/du + V dL/dv).
  const F16 by_q = -(zero_unless(a.hit, a.z * (a.z * by_depth + (a.u * by_u + a.v * by_v))));
  const F16 by_U = zero_unless(a.hit, a.z * by_u), by_V = zero_unless(a.hit, a.z * by_v);
  // Masked, since the product of zero and infinity is NaN.
  const F16 U = zero_unless(a.hit, a.U), V = zero_unless(a.hit, a.V);
  const F16 by_blob = by_exponent - zero_unless(a.hit, by_exponent);
  const F16 of_blob = F16(1.0f / kBlobVariance) * by_blob;
  const F16 q = F16(1.0f / surfel.depth);
  sums[0] += by_U * U;
  sums[1] += by_U * V;
  sums[2] += by_V * U;
  sums[3] += by_V * V;
  sums[4] += by_q * U;
  sums[5] += by_q * V;
  sums[6] += of_blob * a.dx -
             (by_U * F16(surfel.u[0]) + (by_V * F16(surfel.v[0]) + by_q * F16(surfel.w[0])));
  sums[7] += of_blob * a.dy -
             (by_U * F16(surfel.u[1]) + (by_V * F16(surfel.v[1]) + by_q * F16(surfel.w[1])));
  sums[8] += select(a.hit, -(by_q * q * q), by_depth);
  sums[9] += by_exponent;
  for (int c = 0; c < 3; ++c) sums[10 + c] += weight * block.color[c];
  for (int c = 0; c < 3; ++c) sums[13 + c] += weight * block.normal[c];
}

template <bool kDistort>
void raster_surfel_tile_backward(const SurfelRasterInput& in, const SurfelBlockRecord* records,
                                 const SurfelImages<const float>& g, int tile,
                                 SurfelGradient* out) {
  const int left = tile % in.tiles_x * kTileSize, top = tile / in.tiles_x * kTileSize;
  const F16 near_plane = F16(in.near_plane), zero = F16(0.0f);
  const LaneCenters centers = lane_centers();
  BackwardBlock blocks[kBlocksPerTile];
  float passed[kBlocksPerTile] = {};
  for (int b = 0; b < kBlocksPerTile; ++b) {
    const int x = left + kBlockSize * (b % 4), y = top + kBlockSize * (b / 4);
    if (x >= in.width || y >= in.height) continue;
    const SurfelBlockRecord& record = records[kBlocksPerTile * tile + b];
    blocks[b] = backward_block(in, g, record, x, y);
    for (int i = 0; i < kLanes; ++i) {
      if (record.passed[i] > passed[b]) passed[b] = record.passed[i];
    }
  }
  const size_t start = in.tile_offsets[tile];
  for (size_t i = in.tile_offsets[tile + 1]; i-- > start;) {
    const Pair& pair = in.pairs[i];
    if (i >= start + kPrefetchAhead) {
      __builtin_prefetch(in.surfels + in.pairs[i - kPrefetchAhead].splat);
    }
    Surfel surfel = in.surfels[pair.splat];
    surfel.mean[0] -= static_cast<float>(left);
    surfel.mean[1] -= static_cast<float>(top);
    const float index = static_cast<float>(i - start);
    F16 sums[16];
    for (F16& s : sums) s = zero;
    for (uint32_t bits = pair.blocks; bits; bits &= bits - 1) {
      const int b = __builtin_ctz(bits);
      if (index >= passed[b]) continue;
      accumulate_surfel<kDistort>(surfel, block_centers(centers, b), F16(index), near_plane,
                                  blocks[b], sums);
    }
    sum_lanes(sums, reinterpret_cast<float*>(out + i));
  }
}

inline void raster_surfels_backward(const SurfelRasterInput& in, const SurfelBlockRecord* records,
                                    const SurfelImages<const float>& g, int tile,
                                    SurfelGradient* out) {
  if (g.distort) return raster_surfel_tile_backward<true>(in, records, g, tile, out);
  raster_surfel_tile_backward<false>(in, records, g, tile, out);
}

}  // namespace splatpilot::SIMD_LEVEL
