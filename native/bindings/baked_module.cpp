// Python bindings of baked scenes.
#include <algorithm>

#include "bindings/bindings.hpp"
#include "project/baked_scene.hpp"

namespace splatpilot {
namespace {

using namespace nb::literals;

// What Python knows of a lens, by its kind and numbers.
LensArguments lens_from(int distortion, const Doubles<nb::shape<13>>& lens) {
  require(distortion >= 0 && distortion <= 2, "there is no such distortion");
  LensArguments bent{static_cast<DistortionModel>(distortion)};
  const double* next = lens.data();
  for (auto [to, count] : {std::pair{bent.radial, 6},
                           {bent.tangential, 2},
                           {&bent.most_squared_slope, 1},
                           {bent.min_slope, 2},
                           {bent.max_slope, 2}}) {
    std::copy_n(next, count, to);
    next += count;
  }
  return bent;
}

void render_baked(const BakedScene& scene, Renderer& renderer, const Means& means,
                  const Quats& quats, const Means& scales, const Opacities& opacities,
                  const Colors& sh, int sh_degree, const Intrinsics& K, const Pose& X_CW, int width,
                  int height, double near_plane, double far_plane, double eps2d,
                  const Floats<nb::shape<3>>& background, const Output& color, const Output& depth,
                  const Output& alpha, double max_depth, int distortion,
                  const Doubles<nb::shape<13>>& lens) {
  require(sh_degree >= 0, "moving Gaussians need spherical harmonics");
  const GaussianArrays moving = gaussian_arrays(means, quats, scales, opacities, sh, sh_degree);
  Camera camera = camera_from(K, X_CW, width, height, near_plane, far_plane, 0.0, eps2d, false,
                              lens_from(distortion, lens));
  camera.max_depth = static_cast<float>(max_depth);
  check_size(color, camera, 3);
  check_size(depth, camera, 1);
  check_size(alpha, camera, 1);
  Image out{color.data(), 3, depth.data(), 1, DepthMode::kMedian, alpha.data(), {}};
  std::copy_n(background.data(), 3, out.background);
  const Exclusive use(renderer);
  renderer.render(scene.arrays(), moving, camera, out);
}

void render_baked_depth(const BakedScene& scene, Renderer& renderer, const Means& means,
                        const Quats& quats, const Means& scales, const Opacities& opacities,
                        const Colors& sh, int sh_degree, const Intrinsics& K, const Pose& X_CW,
                        int width, int height, double near_plane, double far_plane,
                        double max_depth, const Output& depth, int distortion,
                        const Doubles<nb::shape<13>>& lens) {
  require(sh_degree >= 0, "moving Gaussians need spherical harmonics");
  const GaussianArrays moving = gaussian_arrays(means, quats, scales, opacities, sh, sh_degree);
  Camera camera = camera_from(K, X_CW, width, height, near_plane, far_plane, 0.0, kDepthBlur, false,
                              lens_from(distortion, lens));
  camera.max_depth = static_cast<float>(max_depth);
  camera.depth_alone = true;
  check_size(depth, camera, 1);
  const Image out{nullptr, 0, depth.data(), 1, DepthMode::kMedian, nullptr, {}};
  const Exclusive use(renderer);
  renderer.render(scene.arrays(), moving, camera, out);
}

}  // namespace

void bind_baked(nb::module_& m) {
  nb::class_<BakedScene>(m, "BakedScene", "A static scene in the order and form frames need.")
      .def(
          "__init__",
          [](BakedScene* self, const Means& means, const Quats& quats, const Means& scales,
             const Opacities& opacities, const Colors& sh, int sh_degree) {
            require(sh_degree >= 0, "a baked scene needs spherical harmonics");
            new (self) BakedScene(gaussian_arrays(means, quats, scales, opacities, sh, sh_degree));
          },
          nb::kw_only(), "means"_a, "quats"_a, "scales"_a, "opacities"_a, "sh"_a, "sh_degree"_a)
      .def_prop_ro("count", &BakedScene::count)
      .def(
          "recolored",
          [](const BakedScene& scene, const Colors& sh, int sh_degree) {
            const int coefficients = static_cast<int>(sh.shape(1));
            require(sh.shape(0) == scene.count(), "there must be as many colours as Gaussians");
            require(sh_degree >= 0 && coefficients >= (sh_degree + 1) * (sh_degree + 1),
                    "too few spherical-harmonic coefficients for the degree");
            return BakedScene(scene, sh.data(), coefficients, sh_degree);
          },
          "sh"_a, "sh_degree"_a, "The same Gaussians in other colours.");
  m.def("render_baked", &render_baked, "scene"_a, "renderer"_a, nb::kw_only(), "means"_a, "quats"_a,
        "scales"_a, "opacities"_a, "sh"_a, "sh_degree"_a, "K"_a, "X_CW"_a, "width"_a, "height"_a,
        "near_plane"_a, "far_plane"_a, "eps2d"_a, "background"_a, "color"_a, "depth"_a, "alpha"_a,
        "max_depth"_a, "distortion"_a, "lens"_a,
        "Writes colour, median depth and alpha of the scene and of Gaussians among it.");
  m.def("render_baked_depth", &render_baked_depth, "scene"_a, "renderer"_a, nb::kw_only(),
        "means"_a, "quats"_a, "scales"_a, "opacities"_a, "sh"_a, "sh_degree"_a, "K"_a, "X_CW"_a,
        "width"_a, "height"_a, "near_plane"_a, "far_plane"_a, "max_depth"_a, "depth"_a,
        "distortion"_a, "lens"_a, "Writes the median depth alone.");
}

}  // namespace splatpilot
