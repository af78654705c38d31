// Python bindings of the backward pass of Gaussians.
#include <nanobind/stl/pair.h>

#include "bindings/bindings.hpp"

namespace splatpilot {
namespace {

using namespace nb::literals;

size_t raster_backward(Renderer& renderer, const RenderedFrame& rendered, const Pixels& v_image,
                       const Pixels& v_alpha, const Pixels& image, const Pixels& alpha,
                       const Floats<nb::shape<3>>& background, bool expected_depth, bool absolute,
                       const Writable<nb::shape<-1, 16>>& v_splats,
                       const Writable<nb::shape<-1, 2>>& v_means2d) {
  const Frame& frame = *rendered.frame;
  require(frame.kept, "the frame was not kept for a backward pass");
  const size_t channels = v_image.shape(2);
  require(channels == 1 || channels == 3 || channels == 4, "an image has 1, 3 or 4 channels");
  check_size(v_image, frame.camera, channels);
  check_size(image, frame.camera, channels);
  check_size(v_alpha, frame.camera, 1);
  check_size(alpha, frame.camera, 1);
  require(v_splats.shape(0) == rendered.splat_count && v_means2d.shape(0) == rendered.splat_count,
          "one row of gradients a splat is needed");
  ImageGradient g{};
  if (channels >= 3) g.color = v_image.data();
  if (channels != 3) g.depth = v_image.data() + channels - 1;
  if (channels != 3 && expected_depth) g.expected_depth = image.data() + channels - 1;
  g.stride = static_cast<int>(channels);
  g.alpha = v_alpha.data();
  g.rendered_alpha = alpha.data();
  std::copy_n(background.data(), 3, g.background);
  g.absolute = absolute;

  const nb::gil_scoped_release release;
  const std::scoped_lock lock(renderer.mutex());
  return renderer.raster_backward(frame, g, reinterpret_cast<SplatGradient*>(v_splats.data()),
                                  v_means2d.data());
}

OwnedArray<double, 5, 3> project_backward(
    Renderer& renderer, const RenderedFrame& rendered, const Means& means, const Quats& quats,
    const Means& scales, const Opacities& opacities, const Colors& colors, int sh_degree,
    const Floats<nb::shape<-1, 16>>& v_splats, const Floats<nb::shape<-1, 2>>& v_means2d,
    const Rows3& v_means, const Rows4& v_quats, const Rows3& v_scales,
    const Writable<nb::ndim<1>>& v_opacities, const ColorRows& v_colors, bool overwrite,
    bool overwrite_colors) {
  const Frame& frame = *rendered.frame;
  require(frame.kept, "the frame was not kept for a backward pass");
  const GaussianArrays gaussians =
      gaussian_arrays(means, quats, scales, opacities, colors, sh_degree);
  require(gaussians.count == frame.gaussians, "these are not the Gaussians of the frame");
  require(v_splats.shape(0) == rendered.splat_count && v_means2d.shape(0) == rendered.splat_count,
          "one row of gradients a splat is needed");
  require_rows(gaussians, v_means, v_quats, v_scales, v_opacities, v_colors);
  PoseSums sums;
  {
    const nb::gil_scoped_release release;
    const std::scoped_lock lock(renderer.mutex());
    sums = renderer.project_backward(
        frame, gaussians, reinterpret_cast<const SplatGradient*>(v_splats.data()), v_means2d.data(),
        {v_means.data(), v_quats.data(), v_scales.data(), v_opacities.data(), v_colors.data(),
         overwrite, overwrite_colors});
  }
  OwnedArray<double, 5, 3> rows = new_array<double, 5, 3>();
  std::copy_n(sums.values, 15, rows.data());
  return rows;
}

}  // namespace

void bind_gradients(nb::module_& m) {
  m.def("raster_backward", &raster_backward, "renderer"_a, "frame"_a, nb::kw_only(), "v_image"_a,
        "v_alpha"_a, "image"_a, "alpha"_a, "background"_a, "expected_depth"_a, "absolute"_a,
        "v_splats"_a, "v_means2d"_a,
        "Writes the gradients of a frame's splats; returns how many (Gaussian, 4x4 block) were\n"
        "composited. v_image etc. are derivatives of the loss by image etc.");
  m.def("project_backward", &project_backward, "renderer"_a, "frame"_a, nb::kw_only(), "means"_a,
        "quats"_a, "scales"_a, "opacities"_a, "colors"_a, "sh_degree"_a, "v_splats"_a,
        "v_means2d"_a, "v_means"_a, "v_quats"_a, "v_scales"_a, "v_opacities"_a, "v_colors"_a,
        "overwrite"_a, "overwrite_colors"_a,
        "Adds to, or overwrites, the gradients of the frame's Gaussians. Returns (5, 3) those by\n"
        "R_CW with the camera's centre held, by p_C and by p_W - centre, summed over Gaussians.");
  m.def(
      "multiply_add",
      [](const Renderer& renderer, size_t rounds) {
        const nb::gil_scoped_release release;
        return std::pair(renderer.kernels().multiply_add(rounds), 16 * kFmaChains * rounds);
      },
      "renderer"_a, "rounds"_a, "Does float multiply-adds; returns a sum and how many they were.");
}

}  // namespace splatpilot
