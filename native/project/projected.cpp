// From projected Gaussians to splats, and the Python binding. Scalar: whoever projects in Python
// spends far more there.
#include "project/projected.hpp"

#include <cmath>
#include <cstring>

#include "bindings/bindings.hpp"

namespace splatpilot {
namespace {

bool place(const ProjectedArrays& in, const Camera& camera, size_t i, Splat& s) {
  const double xx = in.covariances[3 * i], xy = in.covariances[3 * i + 1],
               yy = in.covariances[3 * i + 2];
  const double det = xx * yy - xy * xy;
  if (!(xx > 0.0 && yy > 0.0 && det > 0.0)) return false;
  const double x = in.means2d[2 * i], y = in.means2d[2 * i + 1];
  const double scale = kExponentScale;
  s.mean_x = static_cast<float>(x);
  s.mean_y = static_cast<float>(y);
  s.ux = static_cast<float>(scale * std::sqrt(yy / det));
  s.uy = static_cast<float>(-scale * std::sqrt(yy / det) * (xy / yy));
  s.vy = static_cast<float>(scale / std::sqrt(yy));
  s.slope_x = static_cast<float>(xy / yy);
  s.slope_y = static_cast<float>(xy / xx);
  s.depth = in.depths[i];
  s.index = static_cast<uint32_t>(i);
  s.unused = 0;
  std::copy_n(in.colors + 3 * i, 3, s.color);
  s.log2_opacity = std::log2(std::max(in.opacities[i], 1e-30f));

  // alpha >= 1/255 where u^2 + v^2 <= log2(255 o).
  const double budget = static_cast<double>(s.log2_opacity) - kLog2AlphaCut;
  if (!(budget >= 0.0)) return false;
  const double extent_x = std::sqrt(budget * xx) / scale, extent_y = std::sqrt(budget * yy) / scale;
  s.extent_x = static_cast<float>(extent_x);
  s.extent_y = static_cast<float>(extent_y);
  return std::max(extent_x, extent_y) > static_cast<double>(camera.radius_clip) &&
         x + extent_x > 0.0 && x - extent_x < camera.width && y + extent_y > 0.0 &&
         y - extent_y < camera.height && std::isfinite(s.ux + s.uy + s.vy) &&
         std::isfinite(s.mean_x + s.mean_y) && s.depth > 0.0f && std::isfinite(s.depth);
}

using namespace nb::literals;
using Rows = Doubles<nb::shape<-1, 3>>;

RenderedFrame render_projected(Renderer& renderer, const Doubles<nb::shape<-1, 2>>& means2d,
                               const Rows& covariances, const Opacities& depths,
                               const Opacities& opacities, const Means& colors, int width,
                               int height, double radius_clip, DepthMode depth_mode,
                               const Floats<nb::shape<3>>& background, const Output& image,
                               const Output& alpha, bool keep) {
  const size_t n = means2d.shape(0);
  require(covariances.shape(0) == n && depths.shape(0) == n && opacities.shape(0) == n &&
              colors.shape(0) == n,
          "arrays of Gaussians differ in length");
  require(n < (size_t{1} << 32) - kChunkSize, "too many Gaussians");
  check_image_size(width, height);
  const ProjectedArrays projected{
      n, means2d.data(), covariances.data(), depths.data(), opacities.data(), colors.data()};
  Camera camera{};
  camera.width = width;
  camera.height = height;
  camera.radius_clip = static_cast<float>(std::floor(radius_clip));
  require(depth_mode != DepthMode::kMedian, "projected Gaussians have no median depth");
  const Image out = output_image(image, alpha, camera, depth_mode, background);
  const Exclusive use(renderer);
  return RenderedFrame(renderer.render(projected, camera, out, keep));
}

// What the derivative by the covariance needs.
OwnedArray<float, -1, 3> factors(Renderer& renderer, const RenderedFrame& rendered) {
  const auto rows = new_array<float, -1, 3>(rendered.splat_count);
  const Exclusive use(renderer);
  renderer.for_each_splat(*rendered.frame, [&](size_t i, const Splat& s) {
    rows.data()[3 * i] = s.ux;
    rows.data()[3 * i + 1] = s.uy;
    rows.data()[3 * i + 2] = s.vy;
  });
  return rows;
}

}  // namespace

size_t place_splats(const ProjectedArrays& projected, const Camera& camera, size_t begin,
                    size_t end, Splat* splats, uint32_t* depth_bits) {
  size_t count = 0;
  for (size_t i = begin; i < end; ++i) {
    Splat splat;
    if (!place(projected, camera, i, splat)) continue;
    splats[count] = splat;
    std::memcpy(depth_bits + count, &splat.depth, sizeof(uint32_t));
    ++count;
  }
  return count;
}

void bind_projected(nb::module_& m) {
  m.def("render_projected", &render_projected, "renderer"_a, nb::kw_only(), "means2d"_a,
        "covariances"_a, "depths"_a, "opacities"_a, "colors"_a, "width"_a, "height"_a,
        "radius_clip"_a, "depth_mode"_a, "background"_a, "image"_a, "alpha"_a, "keep"_a,
        "As render, of Gaussians that are projected.");
  m.def("splat_factors", &factors, "renderer"_a, "frame"_a,
        "(n, 3) ux, uy, vy of a frame's splats: u = ux dx + uy dy and v = vy dy make the\n"
        "exponent, in base 2, -u^2 - v^2.");
}

}  // namespace splatpilot
