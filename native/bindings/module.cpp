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
  CameraParameters parameters =
      camera_parameters(K, X_CW, width, height, near_plane, far_plane, radius_clip, eps2d);
  parameters.antialiased = antialiased;
  const Camera camera = make_camera(parameters);
  const Image out = output_image(image, alpha, camera, depth_mode, background);
  const Exclusive use(renderer);
  return RenderedFrame(renderer.render(gaussians, camera, out, keep));
}

size_t raster_backward(Renderer& renderer, const RenderedFrame& rendered, const Pixels& v_image,
                       const Pixels& v_alpha, const Pixels& image, const Pixels& alpha,
                       const Floats<nb::shape<3>>& background, bool expected_depth,
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
  return pose_rows(sums);
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
      "quats"_a, "Index of the first quaternion too short or too long to be normalized, or -1.");

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
      .def_prop_ro("simd", [](const Renderer& r) { return std::string(r.kernels().name); });
  m.def("projected", &projected, "renderer"_a, "frame"_a, "opacities"_a.none(),
        "ids (n,), radii (n, 2), means (n, 2), depths (n,), conics (n, 3) and opacities (n,) of\n"
        "a frame's splats.");
  m.def("render", &render, "renderer"_a, nb::kw_only(), "means"_a, "quats"_a, "scales"_a,
        "opacities"_a, "colors"_a, "sh_degree"_a, "K"_a, "X_CW"_a, "width"_a, "height"_a,
        "near_plane"_a, "far_plane"_a, "radius_clip"_a, "eps2d"_a, "antialiased"_a, "depth_mode"_a,
        "background"_a, "image"_a, "alpha"_a, "keep"_a,
        "Writes color (3 channels), depth (1) or both (4) by the shape of image, and alpha. With\n"
        "keep, a backward pass can start from the frame.");
  m.def("raster_backward", &raster_backward, "renderer"_a, "frame"_a, nb::kw_only(), "v_image"_a,
        "v_alpha"_a, "image"_a, "alpha"_a, "background"_a, "expected_depth"_a, "v_splats"_a,
        "v_means2d"_a,
        "Writes the gradients of a frame's splats; returns how many (Gaussian, 4x4 block) were\n"
        "composited. v_image etc. are derivatives of the loss by image etc.");
  m.def("project_backward", &project_backward, "renderer"_a, "frame"_a, nb::kw_only(), "means"_a,
        "quats"_a, "scales"_a, "opacities"_a, "colors"_a, "sh_degree"_a, "v_splats"_a,
        "v_means2d"_a, "v_means"_a, "v_quats"_a, "v_scales"_a, "v_opacities"_a, "v_colors"_a,
        "overwrite"_a, "overwrite_colors"_a,
        "Adds to, or overwrites, the gradients of the frame's Gaussians. Returns (5, 3) those by\n"
        "R_CW with the camera's center held, by p_C and by p_W - center, summed over Gaussians.");

  bind_baked(m);
  bind_surfels(m);
  bind_fitting(m);
  bind_shapes(m);
  bind_grids(m);
}

}  // namespace splatpilot
