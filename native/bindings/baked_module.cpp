// Python bindings of baked scenes.
#include <nanobind/stl/optional.h>

#include <algorithm>
#include <optional>

#include "bindings/bindings.hpp"
#include "project/baked_scene.hpp"

namespace splatpilot {
namespace {

using namespace nb::literals;

void set_lens(CameraParameters& camera, int distortion, const Doubles<nb::shape<13>>& lens) {
  require(distortion >= 0 && distortion <= 2, "there is no such distortion");
  const double* n = lens.data();
  camera.distortion.model = static_cast<DistortionModel>(distortion);
  for (int k = 0; k < 6; ++k) camera.distortion.radial[k] = static_cast<float>(n[k]);
  for (int k = 0; k < 2; ++k) camera.distortion.tangential[k] = static_cast<float>(n[6 + k]);
  camera.distortion.most_squared_slope = static_cast<float>(n[8]);
  std::copy_n(n + 9, 2, camera.min_slope);
  std::copy_n(n + 11, 2, camera.max_slope);
}

void render_baked(const BakedScene& scene, Renderer& renderer, const Means& means,
                  const Quats& quats, const Means& scales, const Opacities& opacities,
                  const Colors& sh, int sh_degree, const Intrinsics& K, const Pose& X_CW, int width,
                  int height, double near_plane, double far_plane, double eps2d,
                  const Floats<nb::shape<3>>& background, const std::optional<Output>& color,
                  const Output& depth, const std::optional<Output>& alpha, double max_depth,
                  int distortion, const Doubles<nb::shape<13>>& lens) {
  require(sh_degree >= 0, "moving Gaussians need spherical harmonics");
  require(color.has_value() == alpha.has_value(), "color and alpha are rendered together");
  const GaussianArrays moving = gaussian_arrays(means, quats, scales, opacities, sh, sh_degree);
  CameraParameters parameters = camera_parameters(K, X_CW, width, height, near_plane, far_plane,
                                                  0.0, color ? eps2d : kDepthBlur);
  set_lens(parameters, distortion, lens);
  Camera camera = make_camera(parameters);
  camera.max_depth = static_cast<float>(max_depth);
  camera.depth_alone = !color;
  check_size(depth, camera, 1);
  Image out{nullptr, 3, depth.data(), 1, DepthMode::kMedian, nullptr, {}};
  if (color) {
    check_size(*color, camera, 3);
    check_size(*alpha, camera, 1);
    out.color = color->data();
    out.alpha = alpha->data();
    std::copy_n(background.data(), 3, out.background);
  }
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
            require(sh.shape(0) == scene.count(), "there must be as many colors as Gaussians");
            require(sh_degree >= 0 && coefficients >= (sh_degree + 1) * (sh_degree + 1),
                    "too few spherical-harmonic coefficients for the degree");
            return BakedScene(scene, sh.data(), coefficients, sh_degree);
          },
          "sh"_a, "sh_degree"_a, "The same Gaussians in other colors.");
  m.def("render_baked", &render_baked, "scene"_a, "renderer"_a, nb::kw_only(), "means"_a, "quats"_a,
        "scales"_a, "opacities"_a, "sh"_a, "sh_degree"_a, "K"_a, "X_CW"_a, "width"_a, "height"_a,
        "near_plane"_a, "far_plane"_a, "eps2d"_a, "background"_a, "color"_a.none(), "depth"_a,
        "alpha"_a.none(), "max_depth"_a, "distortion"_a, "lens"_a,
        "Writes the median depth, and unless they are None color and alpha, of the scene and of\n"
        "Gaussians among it.");
}

}  // namespace splatpilot
