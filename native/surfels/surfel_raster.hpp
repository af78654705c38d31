// Compositing of the surfels of one tile, front to back, 16 pixels at a time.
#pragma once

#include "core/mathematics.hpp"
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

// How a surfel appears in 16 pixels.
struct SurfelSample {
  F16 dx, dy;
  F16 U, V;    // u . d and v . d of the surfel
  F16 u, v;    // where the ray meets the plane, in standard deviations
  F16 z;       // at which depth
  Mask16 hit;  // whether that counts, or else the blob
  F16 r2, depth;
  F16 alpha;  // 0 below the cut
};

// alpha = o exp(-r2 / 2): r2 is the lesser of u^2 + v^2 on the surfel's plane and of the blob's
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

// Composites the staged surfels, of which the first has the index `first` in the tile; returns
// whether any pixel is still open.
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
      // sum_j w_j (z_i - z_j) over those in front, each of which enters both of the pair's terms.
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
void raster_surfels_of(const SurfelRasterInput& in, const SurfelImages<float>& out,
                       SurfelBlockRecord* records, int tile) {
  const int left = tile % in.tiles_x * kTileSize, top = tile / in.tiles_x * kTileSize;
  const F16 zero = F16(0.0f), one = F16(1.0f), near_plane = F16(in.near_plane);
  const LaneCenters centers = lane_centers();
  SurfelBlockState state[kBlocksPerTile];
  uint32_t inside = 0;
  for (int b = 0; b < kBlocksPerTile; ++b) {
    const F16 open = ones_inside(in.width, in.height, centers, left, top, b);
    state[b] = {open, {zero, zero, zero}, {zero, zero, zero}, zero, zero, zero, zero, one, zero,
                -one};
    if (any(open > zero)) inside |= 1u << b;
  }

  StagedSurfels staged;
  uint32_t live = inside;
  const size_t start = in.tile_offsets[tile], end = in.tile_offsets[tile + 1];
  for (size_t begin = start; begin < end && live; begin += kStageSize) {
    const int count = end - begin < kStageSize ? static_cast<int>(end - begin) : kStageSize;
    stage_surfels(in, begin, count, static_cast<float>(left), static_cast<float>(top), staged);
    for (uint32_t bits = live; bits; bits &= bits - 1) {
      const int b = __builtin_ctz(bits);
      const bool open = composite_surfels<kDistort, kRecord>(
          staged, (count + 63) / 64, b, block_centers(centers, b),
          static_cast<float>(begin - start), near_plane, state[b]);
      if (!open) live &= ~(1u << b);
    }
  }
  for (uint32_t bits = inside; bits; bits &= bits - 1) {
    const int b = __builtin_ctz(bits);
    const SurfelBlockState& s = state[b];
    write_surfel_block(out, s, in.width, in.height, left + kBlockSize * (b % 4),
                       top + kBlockSize * (b / 4));
    if constexpr (kRecord) {
      SurfelBlockRecord& record = records[kBlocksPerTile * tile + b];
      store(record.transmittance, s.last_transmittance);
      store(record.passed, s.passed);
      store(record.median, s.median_index);
      store(record.alpha, s.alpha);
      store(record.depth, s.depth);
    }
  }
}

inline void raster_surfels(const SurfelRasterInput& in, const SurfelImages<float>& out,
                           SurfelBlockRecord* records, int tile) {
  if (out.distort) {
    records ? raster_surfels_of<true, true>(in, out, records, tile)
            : raster_surfels_of<true, false>(in, out, records, tile);
  } else {
    records ? raster_surfels_of<false, true>(in, out, records, tile)
            : raster_surfels_of<false, false>(in, out, records, tile);
  }
}

}  // namespace splatpilot::SIMD_LEVEL
