// What the stages of a frame hand to one another, and the table of kernels that exists once per
// SIMD level. Plain data only: this header is shared by objects built for different machines.
#pragma once

#include <cstddef>
#include <cstdint>

#include "backward/backward_types.hpp"

namespace splatpilot {

constexpr int kTileSize = 16;       // [px]
constexpr int kBlockSize = 4;       // [px]; one block is 16 pixels, the width of a pack
constexpr int kBlocksPerTile = 16;  // 4 x 4, one bit each of Pair::blocks
constexpr int kStageSize = 256;     // splats of a tile held at a time
constexpr int kChunkSize = 2048;    // Gaussians projected by one task
constexpr int kPrefetchAhead = 8;   // splats are read in an order that caches cannot guess
constexpr float kMinSquaredNorm = 1e-30f, kMaxSquaredNorm = 1e30f;  // of quaternions
constexpr int kBoundSize = 64;  // baked Gaussians that share one bounding box

constexpr float kAlphaCut = 1.0f / 255.0f;
constexpr float kLog2AlphaCut = -7.994353437f;  // log2(1/255)
constexpr float kMaxAlpha = 0.99f;
constexpr float kMinTransmittance = 1e-4f;
// How far the inverse depth of a Gaussian may fall toward its rim, of that of its center.
constexpr float kMostFall = 0.9f;
// sqrt(2 ln 255) = 3.3291: beyond so many sigmas no opacity <= 1 is above the alpha cut.
constexpr float kMaxExtent = 3.33f;
// The exponent is kept in base 2 and in Cholesky form: alpha = exp2(log2 o - u^2 - v^2) with
// u^2 + v^2 = kExponentScale^2 * (squared Mahalanobis distance); this is sqrt(log2(e) / 2).
constexpr float kExponentScale = 0.849321800288f;

enum class DistortionModel : int { kNone, kOpenCv, kFisheye };

// How a lens bends rays, see systems/splats/lens.py.
struct Distortion {
  DistortionModel model;
  float radial[6], tangential[2];
  float most_squared_slope;  // x^2 + y^2 of x/z, y/z beyond which rays have no place
};

// A camera, prepared for projection.
struct Camera {
  int width, height;            // [px]
  float fx, fy, cx, cy;         // [px]
  float near_plane, far_plane;  // [m]
  float radius_clip, eps2d;     // [px], [px^2]
  bool antialiased;             // opacities fall as the blur spreads small Gaussians
  float max_depth;              // [m]; what lies beyond has no part in the median depth
  bool depth_alone;             // Gaussians that hold no pixel's center are left out, and colors
  float R_CW[9];                // row-major
  // The center in two parts, so that p_W - center keeps its digits far from the world's origin.
  float center_high[3], center_low[3];
  float min_slope_x, max_slope_x, min_slope_y, max_slope_y;  // where x/z, y/z are held in J
  // A Gaussian at p_C with largest scale s can touch the image only if for each of the four sides
  // side_normal . p_C + side_reach s > 0 (left, right, top, bottom).
  float side_normal[4][3];
  float side_reach[4];
  Distortion distortion;
};

// A visible Gaussian on the image plane.
struct alignas(64) Splat {
  float mean_x, mean_y;      // [px]
  float extent_x, extent_y;  // half size of the box outside which alpha is below the cut [px]
  float ux, uy, vy;          // u = ux dx + uy dy, v = vy dy, with d = pixel - mean
  float log2_opacity;
  float color[3];
  float depth;             // z in the camera frame [m]
  float slope_x, slope_y;  // s01 / s11 and s01 / s00 of the 2D covariance
  uint32_t index;          // of the Gaussian in the input
  uint32_t unused;
};
static_assert(sizeof(Splat) == 64);

// How a Gaussian enters the median depth: the inverse depth of the point of greatest density along
// a pixel's ray, W = w + w_x dx + w_y dy, which is the plane n . p = n . mean with
// n = covariance^-1 mean, in the camera frame; and its footprint without blur, as in Splat but for
// a division: u = (ux dx + uy dy) / min(W, w), v = vy dy / min(W, w). So the half that lies farther
// from the camera has the perspective of what is flat; where large, it would be haze without.
struct alignas(32) DepthPlane {
  float ux, uy, vy;
  float w_x, w_y, w;  // [1/(m px)], [1/m]
  float unused[2];
};
static_assert(sizeof(DepthPlane) == 32);

// A splat in a tile and the blocks of the tile that it touches.
struct Pair {
  uint32_t splat;
  uint32_t blocks;
};

// Input tensors as they come: row-major, one row per Gaussian.
struct GaussianArrays {
  size_t count;
  const float* means;      // (N, 3)
  const float* quats;      // (N, 4) wxyz, any length but zero
  const float* scales;     // (N, 3)
  const float* opacities;  // (N,)
  const float* colors;     // (N, 3), or (N, K, 3) when sh_degree >= 0
  int sh_degree;           // -1: colors are given
  int sh_coefficients;     // K
};

// A baked scene: Morton-ordered, in groups of 16 with one pack per quantity. The last group is
// padded with Gaussians of zero opacity (log2_opacity = -inf).
struct BakedArrays {
  size_t groups;
  // mean 3, lower-triangular factor of the covariance 6 (rows: 00; 10 11; 20 21 22), log2 opacity
  const float* geometry;  // (groups, 10, 16)
  const float* colors;    // (groups, 3 K, 16)
  int sh_degree;          // 0: colors are final
  const float* bounds;    // (groups of 16 boxes, 7, 16): center 3, half size 3,
                          // largest scale; one box per kBoundSize Gaussians
};

// sum w z; that divided by alpha; z where what is let through, of footprints without blur, falls
// below one half, 0 where it never does.
enum class DepthMode { kAccumulated, kExpected, kMedian };

// Where tiles write. Strides are in floats; a null pointer means "not wanted".
struct Image {
  float* color;
  int color_stride;
  float* depth;
  int depth_stride;
  DepthMode depth_mode;
  float* alpha;
  float background[3];
};

struct RasterInput {
  const Splat* splats;
  const DepthPlane* planes;    // of the splats, for the median depth
  const Pair* pairs;           // grouped by tile, in depth order
  const size_t* tile_offsets;  // (tiles + 1,)
  int width, height, tiles_x;
};

// A pair before it is sorted by tile.
struct TilePair {
  uint32_t tile;
  Pair pair;
};

// Appends the tile pairs of splats order[begin..end) and counts them per tile; returns where it
// stopped because fewer than one splat's pairs might have fitted, or end.
using BinKernel = size_t (*)(const Splat*, const uint32_t* order, size_t begin, size_t end,
                             int tiles_x, int tiles_y, TilePair*, size_t capacity,
                             size_t* pair_count, uint32_t* tile_counts);

struct SurfelKernels;
struct LossKernels;
struct CastingKernels;
struct FittingKernels;

// Of one SIMD level.
struct Kernels {
  const char* name;
  const SurfelKernels* surfels;
  const LossKernels* losses;
  const CastingKernels* casting;
  const FittingKernels* fitting;
  // Projects Gaussians [begin, end); writes visible ones, their planes if these are not null, and
  // the bits of their depths in input order; returns how many.
  size_t (*project)(const GaussianArrays&, const Camera&, size_t begin, size_t end, Splat*,
                    DepthPlane*, uint32_t* depth_bits);
  size_t (*project_baked)(const BakedArrays&, const Camera&, size_t begin, size_t end, Splat*,
                          DepthPlane*, uint32_t* depth_bits);
  BinKernel bin;
  // With `record`, a backward pass can follow.
  void (*raster_tile)(const RasterInput&, const Image&, const StageWriter* record, int tile);
  // Writes the gradients of a tile's pairs and returns how many (splat, block) it composited;
  // `scratch` has kBackwardScratchBytes, aligned to 64.
  size_t (*raster_tile_backward)(const RasterInput&, const StageReader&, const ImageGradient&,
                                 int tile, void* scratch, PairGradient*);
  // Adds up the pairs of `count` splats.
  void (*gather_gradients)(const Splat*, size_t count, const PairRange*, const uint32_t* slots,
                           const PairGradient*, SplatGradient*);
  // From `count` splats to the Gaussians they came from; `means2d` (count, 2) replaces mean. Adds.
  void (*project_backward)(const GaussianArrays&, const Camera&, const Splat*, size_t count,
                           const SplatGradient*, const float* means2d, const GaussianGradients&,
                           PoseSums*);
  // Index of the first value that is NaN or infinite, or count.
  size_t (*first_nonfinite)(const float*, size_t count);
  // Whether low <= value <= high for all; NaN is not.
  bool (*all_within)(const float*, size_t count, float low, float high);
  // Whether all quaternions (count, 4) are long and short enough to be normalized.
  bool (*all_normalizable)(const float* quats, size_t count);
};

}  // namespace splatpilot
