// Python bindings of the renderer of surfels.
#include <nanobind/stl/optional.h>
#include <nanobind/stl/tuple.h>

#include <algorithm>
#include <cmath>
#include <optional>
#include <tuple>

#include "bindings/bindings.hpp"

namespace splatpilot {
namespace {

struct RenderedSurfels {
  std::shared_ptr<const SurfelFrame> frame;
};

template <typename Image>
auto* plane(const Image& image, const CameraParameters& camera, size_t channels) {
  check_size(image, camera.height, camera.width, channels);
  return image.data();
}

RenderedSurfels render(Renderer& renderer, const Gaussians& surfels, const CameraParameters& given,
                       const Output& color, const Output& normal, const Output& depth,
                       const Output& alpha, const Output& median,
                       const std::optional<Output>& distort, bool keep) {
  CameraParameters camera = given;
  camera.eps2d = kBlobVariance;
  const SurfelImages<float> images{
      plane(color, camera, 3),  plane(normal, camera, 3),
      plane(depth, camera, 1),  plane(alpha, camera, 1),
      plane(median, camera, 1), distort ? plane(*distort, camera, 1) : nullptr};
  const Exclusive use(renderer);
  return {renderer.render_surfels(surfels.arrays(), make_camera(camera), images, keep)};
}

OwnedArray<double, 5, 3> backward(Renderer& renderer, const RenderedSurfels& rendered,
                                  const Gaussians& surfels, const GradientRows& rows,
                                  const std::optional<Pixels>& v_color,
                                  const std::optional<Pixels>& v_normal,
                                  const std::optional<Pixels>& v_depth,
                                  const std::optional<Pixels>& v_alpha,
                                  const std::optional<Pixels>& v_median,
                                  const std::optional<Pixels>& v_distort) {
  const Frame& frame = rendered.frame->bounds;
  check_frame(frame, surfels.arrays());
  const auto plane = [&](const std::optional<Pixels>& image, size_t channels) -> const float* {
    if (!image) return nullptr;
    check_size(*image, frame.camera.height, frame.camera.width, channels);
    return image->data();
  };
  const SurfelImages<const float> gradients{plane(v_color, 3),  plane(v_normal, 3),
                                            plane(v_depth, 1),  plane(v_alpha, 1),
                                            plane(v_median, 1), plane(v_distort, 1)};
  const GaussianGradients out = rows.arrays(surfels.arrays());
  PoseSums sums;
  {
    const Exclusive use(renderer);
    sums = renderer.surfels_backward(*rendered.frame, surfels.arrays(), gradients, out);
  }
  return pose_rows(sums);
}

auto projected(Renderer& renderer, const RenderedSurfels& rendered) {
  const SurfelFrame& frame = *rendered.frame;
  const size_t n = frame.bounds.splat_count();
  const auto ids = new_array<int64_t, -1>(n);
  const auto radii = new_array<int32_t, -1, 2>(n);
  const auto means = new_array<float, -1, 2>(n);
  const auto depths = new_array<float, -1>(n);
  const auto normals = new_array<float, -1, 3>(n);
  const auto write = [&](size_t i, const Splat& bounds) {
    const Surfel& s = frame.surfels[static_cast<size_t>(&bounds - frame.bounds.splats.data())];
    ids.data()[i] = bounds.index;
    const float disc_radius = disc(bounds).radius;
    const float reach_x = std::abs(bounds.mean_x - s.mean[0]) + bounds.extent_x;
    const float reach_y = std::abs(bounds.mean_y - s.mean[1]) + bounds.extent_y;
    radii.data()[2 * i] = radius(std::max(reach_x, disc_radius));
    radii.data()[2 * i + 1] = radius(std::max(reach_y, disc_radius));
    std::copy_n(s.mean, 2, means.data() + 2 * i);
    depths.data()[i] = s.depth;
    std::copy_n(s.normal, 3, normals.data() + 3 * i);
  };
  {
    const Exclusive use(renderer);
    renderer.for_each_splat(frame.bounds, write);
  }
  return std::make_tuple(ids, radii, means, depths, normals);
}

}  // namespace

void bind_surfels(nb::module_& m) {
  nb::class_<RenderedSurfels>(m, "SurfelFrame", "A rendered image of surfels.");
  m.def("render_surfels", &render, "renderer"_a, "surfels"_a, "camera"_a, nb::kw_only(), "color"_a,
        "normal"_a, "depth"_a, "alpha"_a, "median"_a, "distort"_a.none(), "keep"_a,
        "Writes images; with keep, a backward pass can start from the frame.");
  m.def("surfels_backward", &backward, "renderer"_a, "frame"_a, "surfels"_a, "gradients"_a,
        nb::kw_only(), "v_color"_a.none(), "v_normal"_a.none(), "v_depth"_a.none(),
        "v_alpha"_a.none(), "v_median"_a.none(), "v_distort"_a.none(),
        "Writes the gradients of the frame's surfels; returns as project_backward.");
  m.def("projected_surfels", &projected, "renderer"_a, "frame"_a,
        "ids (n,), radii (n, 2), means (n, 2), depths (n,) and normals in the world (n, 3) of a\n"
        "frame's surfels, in the order of the input.");
}

}  // namespace splatpilot
