// Rendering of Gaussians that something else has projected: cameras other than the pinhole.
#pragma once

#include "core/types.hpp"

namespace splatpilot {

struct ProjectedArrays {
  size_t count;
  const double* means2d;      // (N, 2) [px]
  const double* covariances;  // (N, 3) xx, xy, yy [px^2], the pixel's blur included
  const float* depths;        // (N,) [m], positive; the order of compositing
  const float* opacities;     // (N,) in [0, 1]
  const float* colors;        // (N, 3)
};

// Turns Gaussians [begin, end) into splats as Kernels::project does. Of the camera, the size of the
// image and radius_clip matter.
size_t place_splats(const ProjectedArrays& projected, const Camera& camera, size_t begin,
                    size_t end, Splat* splats, uint32_t* depth_bits);

}  // namespace splatpilot
