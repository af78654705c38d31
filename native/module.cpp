// Python bindings. Arguments are checked in Python, where errors can name tensors; here only what
// memory safety needs is checked again.
#include <nanobind/stl/optional.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/vector.h>

#include <cmath>
#include <optional>

#include "baked_scene.hpp"
#include "bindings.hpp"
#include "dispatch.hpp"
#include "losses_module.hpp"

namespace splatpilot {

namespace {

using namespace nb::literals;

nb::dict stage_seconds(const Renderer& renderer) {
  const StageSeconds& s = renderer.seconds();
  nb::dict seconds;
  seconds["project"] = s.project;
  seconds["sort"] = s.sort;
  seconds["bin"] = s.bin;
  seconds["raster"] = s.raster;
  seconds["raster backward"] = s.raster_backward;
  seconds["gather"] = s.gather;
  seconds["project backward"] = s.project_backward;
  return seconds;
}

// What gsplat calls meta, for the splats of the last frame, in the order of the input. Opacities
// are the rows of `given`, or without it those that the splats had.
nb::tuple projected(Renderer& renderer, std::optional<Opacities> given) {
  const std::scoped_lock lock(renderer.mutex());
  require(!given || (renderer.frame() && given->size() == renderer.frame()->gaussians),
          "these are not the Gaussians of the last frame");
  const size_t n = renderer.splat_count();
  const auto ids = new_array<int64_t>({n});
  const auto radii = new_array<int32_t>({n, 2});
  const auto means = new_array<float>({n, 2}), conics = new_array<float>({n, 3});
  const auto depths = new_array<float>({n}), opacities = new_array<float>({n});
  renderer.for_each_splat([&](size_t i, const Splat& s) {
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
  });
  return nb::make_tuple(ids, radii, means, depths, conics, opacities);
}

// Channels are colour (3), depth (1) or colour and depth (4), by the shape of `image`.
size_t render(Renderer& renderer, Means means, Quats quats, Means scales, Opacities opacities,
              Colors colors, int sh_degree, Doubles<nb::shape<3, 3>> K,
              Doubles<nb::shape<4, 4>> X_CW, int width, int height, double near_plane,
              double far_plane, double radius_clip, double eps2d, bool antialiased,
              bool expected_depth, Floats<nb::shape<3>> background, Output image, Output alpha,
              bool keep) {
  const GaussianArrays gaussians =
      gaussian_arrays(means, quats, scales, opacities, colors, sh_degree);
  const Camera camera =
      camera_from(K, X_CW, width, height, near_plane, far_plane, radius_clip, eps2d, antialiased);
  const Image out = output_image(image, alpha, width, height, expected_depth, background);

  const nb::gil_scoped_release release;
  const std::scoped_lock lock(renderer.mutex());
  renderer.render(gaussians, camera, out, keep);
  return renderer.splat_count();
}

void render_baked(const BakedScene& scene, Renderer& renderer, Doubles<nb::shape<3, 3>> K,
                  Doubles<nb::shape<4, 4>> X_CW, int width, int height, double near_plane,
                  double far_plane, double eps2d, Floats<nb::shape<3>> background, Output color,
                  Output depth, Output alpha) {
  const Camera camera = camera_from(K, X_CW, width, height, near_plane, far_plane, 0.0, eps2d);
  check_size(color, width, height, 3);
  check_size(depth, width, height, 1);
  check_size(alpha, width, height, 1);
  Image out{color.data(), 3, depth.data(), 1, true, alpha.data(), {}};
  std::copy_n(background.data(), 3, out.background);

  const nb::gil_scoped_release release;
  const std::scoped_lock lock(renderer.mutex());
  renderer.render(scene.arrays(), camera, out);
}

}  // namespace

NB_MODULE(_native, m) {
  m.doc() = "Splat kernels for CPUs.";
  // Renderers cached per thread live until the interpreter ends, which is no leak.
  nb::set_leak_warnings(false);
  m.def("simd_levels", &simd_levels,
        "Names of the SIMD levels this machine can run, widest first.");
  m.def(
      "first_nonfinite",
      [](Floats<nb::ndim<1>> values, const Renderer& renderer) -> int64_t {
        const size_t i = renderer.kernels().first_nonfinite(values.data(), values.size());
        return i < values.size() ? static_cast<int64_t>(i) : -1;
      },
      "values"_a, "renderer"_a, "Index of the first NaN or infinity, or -1.");

  m.def(
      "scene_is_valid",
      [](Renderer& renderer, Means means, Quats quats, Means scales, Opacities opacities,
         Floats<nb::ndim<1>> colors) {
        const size_t n = means.shape(0);
        require(quats.shape(0) == n && scales.shape(0) == n && opacities.shape(0) == n,
                "arrays of Gaussians differ in length");
        const GaussianArrays gaussians{
            n, means.data(), quats.data(), scales.data(), opacities.data(), colors.data(), -1, 1};
        const nb::gil_scoped_release release;
        const std::scoped_lock lock(renderer.mutex());
        return renderer.are_valid(gaussians, colors.size());
      },
      "renderer"_a, "means"_a, "quats"_a, "scales"_a, "opacities"_a, "colors"_a,
      "Whether every number can be rendered; may be false for scales below 1.2e-38.");

  m.def(
      "first_zero_quaternion",
      [](Quats quats) -> int64_t {
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

  nb::class_<Renderer>(m, "Renderer", "The threads and the scratch memory of a renderer.")
      .def(
          "__init__",
          [](Renderer* self, int threads, const std::string& simd) {
            require(threads >= 1 && threads <= 1024, "threads must lie between 1 and 1024");
            new (self) Renderer(threads, simd);
          },
          "threads"_a, "simd"_a = "")
      .def_prop_ro("simd", [](const Renderer& r) { return std::string(r.kernels().name); })
      .def_prop_ro("pair_count", &Renderer::pair_count, "(Gaussian, tile) pairs of the last frame.")
      .def_prop_ro("seconds", &stage_seconds, "Seconds that each stage of the last frame took.")
      .def("projected", &projected, "opacities"_a.none(),
           "ids (n,), radii (n, 2), means (n, 2), depths (n,), conics (n, 3), "
           "opacities (n,) of the last frame.")
      .def("render", &render);

  nb::class_<BakedScene>(m, "BakedScene", "A static scene in the order and form frames need.")
      .def(
          "__init__",
          [](BakedScene* self, Means means, Quats quats, Means scales, Opacities opacities,
             Colors sh, int sh_degree) {
            require(sh_degree >= 0, "a baked scene needs spherical harmonics");
            new (self) BakedScene(gaussian_arrays(means, quats, scales, opacities, sh, sh_degree));
          },
          "means"_a, "quats"_a, "scales"_a, "opacities"_a, "sh"_a, "sh_degree"_a)
      .def("render", &render_baked);

  bind_losses(m);
  bind_gradients(m);
  bind_surfels(m);
  bind_projected(m);
}

}  // namespace splatpilot
