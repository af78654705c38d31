// Gradients of the surfels of one tile, back to front: surfel by surfel, over the blocks that each
// touches, so that the sums over pixels are taken once per surfel and tile.
#pragma once

#include "core/reduction.hpp"
#include "surfels/surfel_raster.hpp"

namespace splatpilot::SIMD_LEVEL {

// Gradients of the loss with respect to the pixels of a block, and the running state.
struct BackwardBlock {
  F16 color[3], normal[3], depth, alpha, median, distort;
  F16 passed, median_index, all_alpha, all_depth;
  F16 transmittance;               // behind the surfel at hand
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

// Adds what 16 pixels give to the gradient of a surfel; fields as in SurfelGradient.
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
  // Masked, since a product of zero and an infinity is none.
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
void raster_surfels_backward_of(const SurfelRasterInput& in, const SurfelBlockRecord* records,
                                const SurfelImages<const float>& g, int tile, SurfelGradient* out) {
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
  if (g.distort) {
    raster_surfels_backward_of<true>(in, records, g, tile, out);
  } else {
    raster_surfels_backward_of<false>(in, records, g, tile, out);
  }
}

}  // namespace splatpilot::SIMD_LEVEL
