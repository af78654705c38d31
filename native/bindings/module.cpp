// Python bindings. Arguments are checked in Python, where errors can name tensors; here only what
// memory safety needs is checked again.
#include <nanobind/stl/optional.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/tuple.h>
#include <nanobind/stl/vector.h>

#include <cmath>
#include <optional>
#include <tuple>

#include "bindings/bindings.hpp"
#include "core/dispatch.hpp"

namespace splatpilot {

namespace {

using namespace nb::literals;

nb::typed<nb::dict, nb::str, double> stage_seconds(Renderer& renderer) {
  StageSeconds s;
  {
    const Exclusive use(renderer);
    s = renderer.seconds();
  }
  nb::dict seconds;
  seconds["project"] = s.project;
  seconds["sort"] = s.sort;
  seconds["bin"] = s.bin;
  seconds["raster"] = s.raster;
  seconds["raster backward"] = s.raster_backward;
  seconds["gather"] = s.gather;
  seconds["project backward"] = s.project_backward;
  return nb::typed<nb::dict, nb::str, double>(seconds);
}

// What gsplat calls meta, for the splats of a frame, in the order of the input. Opacities are the
// rows of `given`, or without it those that the splats had.
auto projected(Renderer& renderer, const RenderedFrame& rendered,
               const std::optional<Opacities>& given) {
  require(!given || given->size() == rendered.frame->gaussians,
          "these are not the Gaussians of the frame");
  const size_t n = rendered.splat_count;
  const auto ids = new_array<int64_t, -1>(n);
  const auto radii = new_array<int32_t, -1, 2>(n);
  const auto means = new_array<float, -1, 2>(n);
  const auto depths = new_array<float, -1>(n);
  const auto conics = new_array<float, -1, 3>(n);
  const auto opacities = new_array<float, -1>(n);
  const auto write = [&](size_t i, const Splat& s) {
    ids.data()[i] = s.index;
    radii.data()[2 * i] = radius_of(s.extent_x);
    radii.data()[2 * i + 1] = radius_of(s.extent_y);
    means.data()[2 * i] = s.mean_x;
    means.data()[2 * i + 1] = s.mean_y;
    depths.data()[i] = s.depth;
    const float scale = 1.0f / (kExponentScale * kExponentScale);
    conics.data()[3 * i] = s.ux * s.ux * scale;
    conics.data()[3 * i + 1] = s.ux * s.uy * scale;
    conics.data()[3 * i + 2] = (s.uy * s.uy + s.vy * s.vy) * scale;
    opacities.data()[i] = given ? given->data()[s.index] : std::exp2(s.log2_opacity);
  };
  {
    const Exclusive use(renderer);
    renderer.for_each_splat(*rendered.frame, write);
  }
  return std::make_tuple(ids, radii, means, depths, conics, opacities);
}

RenderedFrame render(Renderer& renderer, const Means& means, const Quats& quats,
                     const Means& scales, const Opacities& opacities, const Colors& colors,
                     int sh_degree, const Intrinsics& K, const Pose& X_CW, int width, int height,
                     double near_plane, double far_plane, double radius_clip, double eps2d,
                     bool antialiased, DepthMode depth_mode, const Floats<nb::shape<3>>& background,
                     const Output& image, const Output& alpha, bool keep) {
  const GaussianArrays gaussians =
      gaussian_arrays(means, quats, scales, opacities, colors, sh_degree);
  const Camera camera =
      camera_from(K, X_CW, width, height, near_plane, far_plane, radius_clip, eps2d, antialiased);
  const Image out = output_image(image, alpha, camera, depth_mode, background);
  const Exclusive use(renderer);
  return RenderedFrame(renderer.render(gaussians, camera, out, keep));
}

}  // namespace

NB_MODULE(_native, m) {
  m.doc() = "Splat kernels for CPUs.";
  // Autograd graphs may hold frames until the interpreter ends, which is no leak.
  nb::set_leak_warnings(false);
  m.def("simd_levels", &simd_levels,
        "Names of the SIMD levels this machine can run, widest first.");
  m.def(
      "first_nonfinite",
      [](const Renderer& renderer, const Floats<nb::ndim<1>>& values) -> int64_t {
        const size_t i = renderer.kernels().first_nonfinite(values.data(), values.size());
        return i < values.size() ? static_cast<int64_t>(i) : -1;
      },
      "renderer"_a, "values"_a, "Index of the first NaN or infinity, or -1.");

  m.def(
      "scene_is_valid",
      [](Renderer& renderer, const Means& means, const Quats& quats, const Means& scales,
         const Opacities& opacities, const Floats<nb::ndim<1>>& colors) {
        const size_t n = means.shape(0);
        require(quats.shape(0) == n && scales.shape(0) == n && opacities.shape(0) == n,
                "arrays of Gaussians differ in length");
        const GaussianArrays gaussians{
            n, means.data(), quats.data(), scales.data(), opacities.data(), colors.data(), -1, 1};
        const Exclusive use(renderer);
        return renderer.are_valid(gaussians, colors.size());
      },
      "renderer"_a, nb::kw_only(), "means"_a, "quats"_a, "scales"_a, "opacities"_a, "colors"_a,
      "Whether every number can be rendered; may be false for scales below 1.2e-38.");

  m.def(
      "first_zero_quaternion",
      [](const Quats& quats) -> int64_t {
        for (size_t i = 0; i < quats.shape(0); ++i) {
          const float* q = quats.data() + 4 * i;
          const float squared = q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3];
          if (!(squared >= kMinSquaredNorm && squared <= kMaxSquaredNorm)) {
            return static_cast<int64_t>(i);
          }
        }
        return -1;
      },
      "quats"_a, "Index of the first quaternion too short or too long to be normalised, or -1.");

  nb::enum_<DepthMode>(m, "DepthMode", "What the depth of a pixel is.")
      .value("ACCUMULATED", DepthMode::kAccumulated, "sum w z")
      .value("EXPECTED", DepthMode::kExpected, "sum w z / sum w")
      .value("MEDIAN", DepthMode::kMedian,
             "z where what footprints without blur let through falls below one half, else 0");
  nb::class_<RenderedFrame>(m, "Frame", "What remains of a rendered image.")
      .def_ro("splat_count", &RenderedFrame::splat_count, "Gaussians that were visible.")
      .def_prop_ro(
          "pair_count", [](const RenderedFrame& r) { return r.frame->pairs.size(); },
          "Pairs of a Gaussian and a tile that it touches.");

  nb::class_<Renderer>(m, "Renderer",
                       "Threads and scratch memory, which have no influence on what is rendered.")
      .def(
          "__init__",
          [](Renderer* self, int threads, const std::string& simd) {
            require(threads >= 1 && threads <= 1024, "threads must lie between 1 and 1024");
            new (self) Renderer(threads, simd);
          },
          "threads"_a, "simd"_a = "")
      .def_prop_ro("simd", [](const Renderer& r) { return std::string(r.kernels().name); })
      .def_prop_ro("seconds", &stage_seconds, "Seconds that each stage of the last frame took.");
  m.def("projected", &projected, "renderer"_a, "frame"_a, "opacities"_a.none(),
        "ids (n,), radii (n, 2), means (n, 2), depths (n,), conics (n, 3) and opacities (n,) of\n"
        "a frame's splats.");
  m.def("render", &render, "renderer"_a, nb::kw_only(), "means"_a, "quats"_a, "scales"_a,
        "opacities"_a, "colors"_a, "sh_degree"_a, "K"_a, "X_CW"_a, "width"_a, "height"_a,
        "near_plane"_a, "far_plane"_a, "radius_clip"_a, "eps2d"_a, "antialiased"_a, "depth_mode"_a,
        "background"_a, "image"_a, "alpha"_a, "keep"_a,
        "Writes colour (3 channels), depth (1) or both (4) by the shape of image, and alpha. With\n"
        "keep, a backward pass can start from the frame.");

  bind_baked(m);
  bind_losses(m);
  bind_fitting(m);
  bind_shape_worlds(m);
  bind_descent(m);
  bind_shape_field(m);
  bind_grid_field(m);
  bind_grid_worlds(m);
  bind_gradients(m);
  bind_surfels(m);
  bind_projected(m);
}

}  // namespace splatpilot
