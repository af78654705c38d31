// Plain data that the stages of a frame pass on, and the table of kernels, one per SIMD level. Code
// for different machines shares this header.
#pragma once

#include <cstddef>
#include <cstdint>

namespace splatpilot {

constexpr int kTileSize = 16;       // [px]
constexpr int kBlockSize = 4;       // [px]; a block is 16 pixels, the width of a pack
constexpr int kBlocksPerTile = 16;  // 4 x 4, one bit each of Pair::blocks
constexpr int kStageSize = 256;     // splats of a tile held at a time
constexpr int kChunkSize = 2048;    // Gaussians projected by one task
constexpr int kPrefetchAhead = 8;   // splats are read in an order that caches cannot guess
constexpr float kMinSquaredNorm = 1e-30f, kMaxSquaredNorm = 1e30f;  // of quaternions
constexpr int kBoundSize = 64;   // baked Gaussians that share one bounding box
constexpr int kMergeLevels = 3;  // of 16, 4 and 1 merged Gaussians a box
constexpr size_t kBackwardScratchBytes = 576 * 1024;

constexpr float kAlphaCut = 1.0f / 255.0f;
constexpr float kLog2AlphaCut = -7.994353437f;  // log2(1/255)
constexpr float kMaxAlpha = 0.99f;
constexpr float kMinTransmittance = 1e-4f;
// The largest fall of a Gaussian's inverse depth toward its rim, relative to that of its center.
constexpr float kMaxFall = 0.9f;
// sqrt(2 ln 255) = 3.3291: beyond so many sigmas no opacity <= 1 is above the alpha cut.
constexpr float kMaxExtent = 3.33f;
// alpha = exp2(log2 o - u^2 - v^2) with u^2 + v^2 = kExponentScale^2 * (squared Mahalanobis
// distance); this is sqrt(log2(e) / 2).
constexpr float kExponentScale = 0.849321800288f;

enum class DistortionModel : int { kNone, kOpenCv, kFisheye };

// A lens, see systems/splats/lens.py.
struct Distortion {
  DistortionModel model;
  float radial[6], tangential[2];
  float max_squared_slope;  // of x^2 + y^2, of rays x/z, y/z that meet the image plane
};

// A camera, prepared for projection.
struct Camera {
  int width, height;            // [px]
  float fx, fy, cx, cy;         // [px]
  float near_plane, far_plane;  // [m]
  float radius_clip, eps2d;     // [px], [px^2]
  bool antialiased;             // opacities fall as the blur spreads small Gaussians
  float max_depth;              // [m], of the median depth
  float merged_spread;          // [px] of baked Gaussians that are drawn as one; 0 merges none
  bool depth_alone;             // no colors; Gaussians that hold no pixel's center are left out
  float R_CW[9];                // row-major
  // The center in two parts, so that p_W - center keeps its digits far from the world's origin.
  float center_high[3], center_low[3];
  float min_slope_x, max_slope_x, min_slope_y, max_slope_y;  // bounds of x/z, y/z in J
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

// A Gaussian in the median depth. The point of greatest density along a pixel's ray has the inverse
// depth W = w + w_x dx + w_y dy: the plane n . p = n . mean with n = covariance^-1 mean, in the
// camera frame. The footprint is without blur, with u = (ux dx + uy dy) / min(W, w) and
// v = vy dy / min(W, w): the far half has the perspective of a flat Gaussian.
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

// Input tensors: row-major, one row per Gaussian.
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
  // Merged Gaussians, or null: a group for each box and level, as above, and the root mean square
  // distance of the centers that merge, the largest of the box; infinite if none merge.
  const float* merged_geometry;  // (boxes, levels, 10, 16)
  const float* merged_colors;    // (boxes, levels, 3 K, 16)
  const float* spreads;          // (groups of 16 boxes, levels, 16)
};

// sum w z; that divided by alpha; or z where the transmittance of footprints without blur falls
// below one half, 0 without one.
enum class DepthMode { kAccumulated, kExpected, kMedian };

// Images that tiles write. Strides are in floats; a null pointer leaves an image out.
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

// The start of a backward pass: transmittance (16 blocks of 16 pixels) at the start of the second
// and later stages of a tile, from entry later_stages[tile] on; and the number of stages composited
// before every pixel was finished. The backward pass reads it as constant Float and Count.
template <typename Float, typename Count>
struct StageRecord {
  const size_t* later_stages;  // (tiles + 1,)
  Float* transmittance;
  Count* stages_done;  // (tiles,)
};
using StageWriter = StageRecord<float, uint32_t>;
using StageReader = StageRecord<const float, const uint32_t>;

// The loss's derivatives by the images; strides as in Image.
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

// The arrays to which dL/d(inputs) of one camera are added; shapes as in GaussianArrays.
struct GaussianGradients {
  float* means;
  float* quats;
  float* scales;
  float* opacities;
  float* colors;
  // Rows, or those of colors, are overwritten instead, with zeros for invisible Gaussians.
  bool overwrite, overwrite_colors;
};

// dL/dR_CW with the center fixed (9, row-major), dL/dp_C (3) and the part of dL/d(p_W - center)
// from spherical harmonics (3), summed over Gaussians.
struct PoseSums {
  double values[15];
};

// Appends the tile pairs of splats order[begin..end) and counts them per tile. Returns the first
// splat whose pairs might not have fitted, or end.
using BinKernel = size_t (*)(const Splat*, const uint32_t* order, size_t begin, size_t end,
                             int tiles_x, int tiles_y, TilePair*, size_t capacity,
                             size_t* pair_count, uint32_t* tile_counts);

struct SurfelKernels;
struct LossKernels;
struct CastingKernels;
struct FlightKernels;

// The kernels of one SIMD level.
struct Kernels {
  const char* name;
  const SurfelKernels* surfels;
  const LossKernels* losses;
  const CastingKernels* casting;
  const FlightKernels* flight;
  // Projects Gaussians [begin, end). Writes visible ones, their planes unless null, and the bits of
  // their depths in input order; returns their number.
  size_t (*project)(const GaussianArrays&, const Camera&, size_t begin, size_t end, Splat*,
                    DepthPlane*, uint32_t* depth_bits);
  // begin and end are multiples of the chunk size, or the scene's end.
  size_t (*project_baked)(const BakedArrays&, const Camera&, size_t begin, size_t end, Splat*,
                          DepthPlane*, uint32_t* depth_bits);
  BinKernel bin;
  // `record` is null when no backward pass follows.
  void (*raster_tile)(const RasterInput&, const Image&, const StageWriter* record, int tile);
  // Writes the gradients of a tile's pairs; `scratch` has kBackwardScratchBytes, aligned to 64.
  void (*raster_tile_backward)(const RasterInput&, const StageReader&, const ImageGradient&,
                               int tile, void* scratch, PairGradient*);
  // Adds up the pairs of `count` splats.
  void (*sum_pairs)(const Splat*, size_t count, const PairRange*, const uint32_t* slots,
                    const PairGradient*, SplatGradient*);
  // From `count` splats to their Gaussians; `means2d` (count, 2) replaces mean. Adds.
  void (*project_backward)(const GaussianArrays&, const Camera&, const Splat*, size_t count,
                           const SplatGradient*, const float* means2d, const GaussianGradients&,
                           PoseSums*);
  // Checks low <= value <= high for all; NaN fails.
  bool (*all_within)(const float*, size_t count, float low, float high);
  // Checks that all quaternions (count, 4) can be normalized.
  bool (*all_normalizable)(const float* quats, size_t count);
};

}  // namespace splatpilot
