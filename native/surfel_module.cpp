// Python bindings of the surfel renderer. Arguments are checked in Python, where errors can name
// tensors; here only what memory safety needs is checked again.
#include <nanobind/stl/optional.h>
#include <nanobind/stl/string.h>

#include <algorithm>
#include <cmath>
#include <optional>

#include "bindings.hpp"
#include "surfels.hpp"

namespace splatpilot {
namespace {

using namespace nb::literals;

template <typename... Shape>
using Sums = nb::ndarray<float, Shape..., nb::c_contig, nb::device::cpu>;
using Plane = Output;
using ConstPlane = std::optional<Floats<nb::ndim<3>>>;

template <typename Image>
auto* plane(const Image& image, const Camera& camera, size_t channels) {
  require(image.shape(0) == static_cast<size_t>(camera.height) &&
              image.shape(1) == static_cast<size_t>(camera.width) && image.shape(2) == channels,
          "an image has the wrong shape");
  return image.data();
}

const float* optional_plane(const ConstPlane& image, const Camera& camera, size_t channels) {
  return image ? plane(*image, camera, channels) : nullptr;
}

void render(SurfelRenderer& renderer, Means means, Quats quats, Means scales, Opacities opacities,
            Colors colors, int sh_degree, Doubles<nb::shape<3, 3>> K, Doubles<nb::shape<4, 4>> X_CW,
            int width, int height, double near_plane, double far_plane, double radius_clip,
            Plane color, Plane normal, Plane depth, Plane alpha, Plane median,
            std::optional<Plane> distort, bool record) {
  const GaussianArrays surfels =
      gaussian_arrays(means, quats, scales, opacities, colors, sh_degree);
  const Camera camera =
      camera_from(K, X_CW, width, height, near_plane, far_plane, radius_clip, kBlobVariance);
  const SurfelImages<float> images{
      plane(color, camera, 3),  plane(normal, camera, 3),
      plane(depth, camera, 1),  plane(alpha, camera, 1),
      plane(median, camera, 1), distort ? plane(*distort, camera, 1) : nullptr};
  const nb::gil_scoped_release release;
  const std::scoped_lock lock(renderer.mutex());
  renderer.render(surfels, camera, images, record);
}

// Adds to the arrays of gradients; returns that of the camera as (5, 3): R, t and the centre.
nb::ndarray<nb::numpy, double> backward(SurfelRenderer& renderer, Means means, Quats quats,
                                        Means scales, Opacities opacities, Colors colors,
                                        int sh_degree, ConstPlane color, ConstPlane normal,
                                        ConstPlane depth, ConstPlane alpha, ConstPlane median,
                                        ConstPlane distort, Sums<nb::ndim<2>> by_means,
                                        Sums<nb::ndim<2>> by_quats, Sums<nb::ndim<2>> by_scales,
                                        Sums<nb::ndim<1>> by_opacities, Plane by_colors) {
  const GaussianArrays surfels =
      gaussian_arrays(means, quats, scales, opacities, colors, sh_degree);
  require(by_means.size() == means.size() && by_quats.size() == quats.size() &&
              by_scales.size() == scales.size() && by_opacities.size() == opacities.size() &&
              by_colors.size() == colors.size(),
          "arrays of gradients have the wrong shape");
  const auto by_camera_rows = new_array<double>({5, 3});
  double* values = by_camera_rows.data();
  {
    const nb::gil_scoped_release release;
    const std::scoped_lock lock(renderer.mutex());
    const auto frame = renderer.frame();
    require(frame && frame->gaussians == surfels.count, "not the surfels of the last frame");
    const Camera& camera = frame->camera;
    const SurfelImages<const float> gradients{
        optional_plane(color, camera, 3),  optional_plane(normal, camera, 3),
        optional_plane(depth, camera, 1),  optional_plane(alpha, camera, 1),
        optional_plane(median, camera, 1), optional_plane(distort, camera, 1)};
    const CameraGradient by_camera =
        renderer.backward(surfels, gradients,
                          {by_means.data(), by_quats.data(), by_scales.data(), by_opacities.data(),
                           by_colors.data()});
    std::copy_n(by_camera.R, 9, values);
    std::copy_n(by_camera.t, 3, values + 9);
    std::copy_n(by_camera.centre, 3, values + 12);
  }
  return by_camera_rows;
}

// ids (n,), radii (n, 2), means (n, 2), depths (n,) and normals in the world (n, 3) of the last
// frame, in the order of the input.
nb::tuple projected(SurfelRenderer& renderer) {
  const std::scoped_lock lock(renderer.mutex());
  const size_t n = renderer.splat_count();
  const auto ids = new_array<int64_t>({n});
  const auto radii = new_array<int32_t>({n, 2});
  const auto means = new_array<float>({n, 2}), normals = new_array<float>({n, 3});
  const auto depths = new_array<float>({n});
  renderer.for_each_surfel([&](size_t i, const Splat& bounds, const Surfel& s) {
    ids.data()[i] = bounds.index;
    const float radius = disc_of(bounds).radius;
    const float reach_x = std::abs(bounds.mean_x - s.mean[0]) + bounds.extent_x;
    const float reach_y = std::abs(bounds.mean_y - s.mean[1]) + bounds.extent_y;
    radii.data()[2 * i] = radius_of(std::max(reach_x, radius));
    radii.data()[2 * i + 1] = radius_of(std::max(reach_y, radius));
    std::copy_n(s.mean, 2, means.data() + 2 * i);
    depths.data()[i] = s.depth;
    std::copy_n(s.normal, 3, normals.data() + 3 * i);
  });
  return nb::make_tuple(ids, radii, means, depths, normals);
}

}  // namespace

void bind_surfels(nb::module_& m) {
  nb::class_<SurfelRenderer, Renderer>(m, "SurfelRenderer", "A Renderer of surfels.")
      .def(
          "__init__",
          [](SurfelRenderer* self, int threads, const std::string& simd) {
            require(threads >= 1 && threads <= 1024, "threads must lie between 1 and 1024");
            new (self) SurfelRenderer(threads, simd);
          },
          "threads"_a, "simd"_a = "")
      .def_prop_ro("pair_count", &SurfelRenderer::pair_count,
                   "(surfel, tile) pairs of the last frame.")
      .def("projected", &projected)
      .def("render", &render, "means"_a, "quats"_a, "scales"_a, "opacities"_a, "colors"_a,
           "sh_degree"_a, "K"_a, "X_CW"_a, "width"_a, "height"_a, "near_plane"_a, "far_plane"_a,
           "radius_clip"_a, "color"_a, "normal"_a, "depth"_a, "alpha"_a, "median"_a,
           "distort"_a.none(), "record"_a)
      .def("backward", &backward, "means"_a, "quats"_a, "scales"_a, "opacities"_a, "colors"_a,
           "sh_degree"_a, "color"_a.none(), "normal"_a.none(), "depth"_a.none(), "alpha"_a.none(),
           "median"_a.none(), "distort"_a.none(), "by_means"_a, "by_quats"_a, "by_scales"_a,
           "by_opacities"_a, "by_colors"_a);
}

}  // namespace splatpilot
