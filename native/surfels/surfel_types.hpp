// Plain data of the surfel renderer (2D Gaussian splatting; Huang et al. 2024).
#pragma once

#include "core/types.hpp"

namespace splatpilot {

// The pixel's low-pass filter: a blob with a standard deviation of sqrt(1/2) px.
constexpr float kBlobVariance = 0.5f;
// Surfels whose plane meets the ray through their center at a smaller sine are edge-on: only their
// blob is drawn.
constexpr float kEdgeOn = 1e-5f;
// exp(-r2 / 2) = exp2(-kHalfLog2e r2).
constexpr float kHalfLog2e = 0.72134752f;

// A visible surfel. With d = (pixel - mean, 1) the ray through the pixel meets its plane at the
// depth z = 1 / (w . d), at z (u . d) and z (v . d) standard deviations from its center. The third
// entries correct the rounding of mean; that of w adds the inverse depth of the center. Edge-on, w
// is (0, 0, -1): no ray meets the plane in front of the camera.
struct Surfel {
  float mean[2];           // [px]
  float u[3], v[3], w[3];  // [1/(m px)], the third entries [1/m]
  float depth;             // of the center [m]
  float log2_opacity;
  float color[3];
  float normal[3];  // in the world, toward the camera
};
constexpr int kSurfelFields = sizeof(Surfel) / sizeof(float);

// A surfel may reach the pixels of an ellipse and of a disc. A Splat holds the ellipse, and the
// disc instead of a color.
struct Disc {
  float x, y, radius;  // [px]
};
inline __attribute__((always_inline)) Disc disc(const Splat& bounds) {
  return {bounds.color[0], bounds.color[1], bounds.color[2]};
}

// Row-major images, or their gradients; null pointers leave some out.
template <typename T>
struct SurfelImages {
  T* color;    // (H, W, 3)
  T* normal;   // (H, W, 3), in the world
  T* depth;    // (H, W), sum of weight and depth
  T* alpha;    // (H, W)
  T* median;   // (H, W)
  T* distort;  // (H, W)
};

// The start of the backward pass of 16 pixels: the transmittance behind the last surfel drawn, the
// number of the tile's surfels passed before the pixel was finished, the index of that of the
// median depth or -1, and the sums of weights and of weighted depths.
struct alignas(64) SurfelBlockRecord {
  float transmittance[16], passed[16], median[16], alpha[16], depth[16];
};

struct SurfelRasterInput {
  const Surfel* surfels;
  const Pair* pairs;           // grouped by tile, in depth order
  const size_t* tile_offsets;  // (tiles + 1,)
  int width, height, tiles_x;
  float near_plane;  // rays that meet a surfel nearer than this miss it [m]
};

// Derivatives of the loss, summed over the pixels of a tile, by fields of a Surfel and, in
// `exponent`, by log alpha. Those by u, v and w are vectors d times a number; its products with
// (u . d, v . d) keep the digits of needles.
struct alignas(64) SurfelGradient {
  float u[2], v[2], w[2], mean[2], depth, exponent, color[3], normal[3];
};
static_assert(sizeof(SurfelGradient) == 64);

struct SurfelKernels {
  size_t (*project)(const GaussianArrays&, const Camera&, size_t begin, size_t end, Splat* bounds,
                    Surfel*, uint32_t* depth_bits);
  BinKernel bin;
  // `records` (tiles, 16) are null when no backward pass follows.
  void (*raster_tile)(const SurfelRasterInput&, const SurfelImages<float>&,
                      SurfelBlockRecord* records, int tile);
  // Writes the gradients of a tile's pairs.
  void (*raster_tile_backward)(const SurfelRasterInput&, const SurfelBlockRecord* records,
                               const SurfelImages<const float>& gradients, int tile,
                               SurfelGradient*);
  // From gradients of `count` surfels, with `indices` in the input, to those of the input and of
  // the camera.
  void (*project_backward)(const GaussianArrays&, const Camera&, const uint32_t* indices,
                           const SurfelGradient*, size_t count, const GaussianGradients&,
                           PoseSums*);
};

}  // namespace splatpilot
