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

using namespace nb::literals;

struct RenderedSurfels {
  std::shared_ptr<const SurfelFrame> frame;
};

template <typename Array>
auto* plane(const Array& image, const Camera& camera, size_t channels) {
  check_size(image, camera, channels);
  return image.data();
}

template <typename Array>
auto* plane(const std::optional<Array>& image, const Camera& camera, size_t channels) {
  return image ? plane(*image, camera, channels) : nullptr;
}

RenderedSurfels render(Renderer& renderer, const Means& means, const Quats& quats,
                       const Means& scales, const Opacities& opacities, const Colors& colors,
                       int sh_degree, const Intrinsics& K, const Pose& X_CW, int width, int height,
                       double near_plane, double far_plane, double radius_clip, const Output& color,
                       const Output& normal, const Output& depth, const Output& alpha,
                       const Output& median, const std::optional<Output>& distort, bool keep) {
  const GaussianArrays surfels =
      gaussian_arrays(means, quats, scales, opacities, colors, sh_degree);
  const Camera camera = make_camera(
      camera_parameters(K, X_CW, width, height, near_plane, far_plane, radius_clip, kBlobVariance));
  const SurfelImages<float> images{plane(color, camera, 3),  plane(normal, camera, 3),
                                   plane(depth, camera, 1),  plane(alpha, camera, 1),
                                   plane(median, camera, 1), plane(distort, camera, 1)};
  const Exclusive use(renderer);
  return {renderer.render_surfels(surfels, camera, images, keep)};
}

OwnedArray<double, 5, 3> backward(
    Renderer& renderer, const RenderedSurfels& rendered, const Means& means, const Quats& quats,
    const Means& scales, const Opacities& opacities, const Colors& colors, int sh_degree,
    const std::optional<Pixels>& v_color, const std::optional<Pixels>& v_normal,
    const std::optional<Pixels>& v_depth, const std::optional<Pixels>& v_alpha,
    const std::optional<Pixels>& v_median, const std::optional<Pixels>& v_distort,
    const Rows3& v_means, const Rows4& v_quats, const Rows3& v_scales,
    const Writable<nb::ndim<1>>& v_opacities, const ColorRows& v_colors, bool overwrite,
    bool overwrite_colors) {
  const Frame& frame = rendered.frame->bounds;
  require(frame.kept, "the frame was not kept for a backward pass");
  const GaussianArrays surfels =
      gaussian_arrays(means, quats, scales, opacities, colors, sh_degree);
  require(surfels.count == frame.gaussians, "these are not the surfels of the frame");
  require_rows(surfels, v_means, v_quats, v_scales, v_opacities, v_colors);
  const Camera& camera = frame.camera;
  const SurfelImages<const float> gradients{
      plane(v_color, camera, 3), plane(v_normal, camera, 3), plane(v_depth, camera, 1),
      plane(v_alpha, camera, 1), plane(v_median, camera, 1), plane(v_distort, camera, 1)};
  PoseSums sums;
  {
    const Exclusive use(renderer);
    sums = renderer.surfels_backward(
        *rendered.frame, surfels, gradients,
        {v_means.data(), v_quats.data(), v_scales.data(), v_opacities.data(), v_colors.data(),
         overwrite, overwrite_colors});
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
    const float radius = disc_of(bounds).radius;
    const float reach_x = std::abs(bounds.mean_x - s.mean[0]) + bounds.extent_x;
    const float reach_y = std::abs(bounds.mean_y - s.mean[1]) + bounds.extent_y;
    radii.data()[2 * i] = radius_of(std::max(reach_x, radius));
    radii.data()[2 * i + 1] = radius_of(std::max(reach_y, radius));
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
  nb::class_<RenderedSurfels>(m, "SurfelFrame", "What remains of a rendered image of surfels.");
  m.def("render_surfels", &render, "renderer"_a, nb::kw_only(), "means"_a, "quats"_a, "scales"_a,
        "opacities"_a, "colors"_a, "sh_degree"_a, "K"_a, "X_CW"_a, "width"_a, "height"_a,
        "near_plane"_a, "far_plane"_a, "radius_clip"_a, "color"_a, "normal"_a, "depth"_a, "alpha"_a,
        "median"_a, "distort"_a.none(), "keep"_a,
        "Writes images; with keep, a backward pass can start from the frame.");
  m.def("surfels_backward", &backward, "renderer"_a, "frame"_a, nb::kw_only(), "means"_a, "quats"_a,
        "scales"_a, "opacities"_a, "colors"_a, "sh_degree"_a, "v_color"_a.none(),
        "v_normal"_a.none(), "v_depth"_a.none(), "v_alpha"_a.none(), "v_median"_a.none(),
        "v_distort"_a.none(), "v_means"_a, "v_quats"_a, "v_scales"_a, "v_opacities"_a, "v_colors"_a,
        "overwrite"_a, "overwrite_colors"_a,
        "Adds to, or overwrites, the gradients of the frame's surfels; returns what\n"
        "project_backward does.");
  m.def("projected_surfels", &projected, "renderer"_a, "frame"_a,
        "ids (n,), radii (n, 2), means (n, 2), depths (n,) and normals in the world (n, 3) of a\n"
        "frame's surfels, in the order of the input.");
}

}  // namespace splatpilot
