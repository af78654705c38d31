// What a backward pass starts from, and what its stages hand to one another. Plain data, as in
// types.hpp.
#pragma once

#include <cstddef>
#include <cstdint>

namespace splatpilot {

constexpr size_t kBackwardScratchBytes = 576 * 1024;

// What a backward pass starts from: transmittance (16 blocks of 16 pixels) where the second and
// later stages of a tile start, from entry later_stages[tile] on; and how many stages were
// composited before every pixel was finished. Written by the forward pass, or read: then with
// constant Float and Count.
template <typename Float, typename Count>
struct StageRecord {
  const size_t* later_stages;  // (tiles + 1,)
  Float* transmittance;
  Count* stages_done;  // (tiles,)
};
using StageWriter = StageRecord<float, uint32_t>;
using StageReader = StageRecord<const float, const uint32_t>;

// The loss's derivatives by what was rendered; strides as in Image.
struct ImageGradient {
  const float* color;
  const float* depth;
  int stride;  // of color and depth
  const float* alpha;
  const float* expected_depth;  // the rendered depth, if it was divided by alpha, else null
  const float* rendered_alpha;
  float background[3];
};

// Sums over pixels for one (splat, tile), h = alpha dL/dalpha: h, h u, h v, h u^2, h u v, h v^2,
// dL/dcolor (3), dL/ddepth.
struct alignas(64) PairGradient {
  float sums[16];
};

// dL/d: mean (2) [1/px]; ln of the opacity; h u^2, h u v, h v^2; color (3); depth.
struct SplatGradient {
  float mean[2], log_opacity, uu, uv, vv, color[3], depth;
  float unused[6];
};
static_assert(sizeof(SplatGradient) == 64);

// The pairs of a splat: those at slots[begin], ..., slots[end - 1].
struct PairRange {
  uint32_t begin, end;
};

// Where dL/d(inputs) of one camera is added; shapes as in GaussianArrays.
struct GaussianGradients {
  float* means;
  float* quats;
  float* scales;
  float* opacities;
  float* colors;
  // Whether rows, or those of colors, are to be written, zeros included, instead of added to.
  bool overwrite, overwrite_colors;
};

// dL/dR_CW with the center held (9, row-major), dL/dp_C (3) and dL/d(p_W - center) by way of
// spherical harmonics alone (3), summed over Gaussians.
struct PoseSums {
  double values[15];
};

}  // namespace splatpilot
