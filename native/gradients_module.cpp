// Python bindings of the backward pass.
#include <nanobind/stl/pair.h>
#include <nanobind/stl/vector.h>

#include "bindings.hpp"

namespace splatpilot {
namespace {

using namespace nb::literals;

template <typename... Shape>
using Writable = nb::ndarray<float, Shape..., nb::c_contig, nb::device::cpu>;
using Pixels = Floats<nb::ndim<3>>;

// Handed to Python instead of Frame: nothing there may change it.
struct KeptFrame {
  std::shared_ptr<const Frame> frame;
  size_t splats, gaussians;
};

void check_pixels(const Pixels& array, const Camera& camera, size_t channels) {
  require(array.shape(0) == static_cast<size_t>(camera.height) &&
              array.shape(1) == static_cast<size_t>(camera.width) && array.shape(2) == channels,
          "an image has the wrong shape");
}

size_t raster_backward(Renderer& renderer, const KeptFrame& kept, Pixels v_image, Pixels v_alpha,
                       Pixels image, Pixels alpha, Floats<nb::shape<3>> background,
                       bool expected_depth, bool absolute,
                       Writable<nb::shape<-1, 16>> splat_gradients,
                       Writable<nb::shape<-1, 2>> v_means2d) {
  const Camera& camera = kept.frame->camera;
  const size_t channels = v_image.shape(2);
  require(channels == 1 || channels == 3 || channels == 4, "an image has 1, 3 or 4 channels");
  check_pixels(v_image, camera, channels);
  check_pixels(image, camera, channels);
  check_pixels(v_alpha, camera, 1);
  check_pixels(alpha, camera, 1);
  require(splat_gradients.shape(0) == kept.splats && v_means2d.shape(0) == kept.splats,
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
  return renderer.raster_backward(
      *kept.frame, g, reinterpret_cast<SplatGradient*>(splat_gradients.data()), v_means2d.data());
}

// Returns PoseSums.
std::vector<double> project_backward(
    Renderer& renderer, const KeptFrame& kept, Means means, Quats quats, Means scales,
    Opacities opacities, Colors colors, int sh_degree, Floats<nb::shape<-1, 16>> splat_gradients,
    Floats<nb::shape<-1, 2>> v_means2d, Writable<nb::shape<-1, 3>> v_means,
    Writable<nb::shape<-1, 4>> v_quats, Writable<nb::shape<-1, 3>> v_scales,
    Writable<nb::ndim<1>> v_opacities, Writable<nb::shape<-1, -1, 3>> v_colors, bool overwrite,
    bool overwrite_colors) {
  const GaussianArrays gaussians =
      gaussian_arrays(means, quats, scales, opacities, colors, sh_degree);
  require(gaussians.count == kept.gaussians, "these are not the Gaussians of the frame");
  require(splat_gradients.shape(0) == kept.splats && v_means2d.shape(0) == kept.splats,
          "one row of gradients a splat is needed");
  const size_t n = gaussians.count;
  require(v_means.shape(0) == n && v_quats.shape(0) == n && v_scales.shape(0) == n &&
              v_opacities.shape(0) == n && v_colors.shape(0) == n &&
              v_colors.shape(1) == colors.shape(1),
          "gradients and Gaussians differ in shape");
  const nb::gil_scoped_release release;
  const std::scoped_lock lock(renderer.mutex());
  const PoseSums sums = renderer.project_backward(
      *kept.frame, gaussians, reinterpret_cast<const SplatGradient*>(splat_gradients.data()),
      v_means2d.data(),
      {v_means.data(), v_quats.data(), v_scales.data(), v_opacities.data(), v_colors.data(),
       overwrite, overwrite_colors});
  return {std::begin(sums.values), std::end(sums.values)};
}

}  // namespace

void bind_gradients(nb::module_& m) {
  nb::class_<KeptFrame>(m, "Frame", "What the backward pass of one rendered image starts from.")
      .def_ro("splat_count", &KeptFrame::splats, "Gaussians that were visible.");
  m.def(
      "kept_frame",
      [](Renderer& renderer) {
        const std::scoped_lock lock(renderer.mutex());
        const std::shared_ptr<const Frame> frame = renderer.frame();
        require(frame && frame->kept, "the last frame was not kept");
        return KeptFrame{frame, frame->splat_count(), frame->gaussians};
      },
      "renderer"_a, "The last frame, if it was rendered with keep=True.");
  m.def("raster_backward", &raster_backward,
        "Writes (n, 16) gradients; returns how many (Gaussian, 4x4 block) were composited.");
  m.def(
      "multiply_add",
      [](Renderer& renderer, size_t rounds) {
        const nb::gil_scoped_release release;
        return std::pair(renderer.kernels().multiply_add(rounds), 16 * kFmaChains * rounds);
      },
      "renderer"_a, "rounds"_a, "Does float multiply-adds; returns a sum and how many they were.");
  m.def("project_backward", &project_backward);
}

}  // namespace splatpilot
