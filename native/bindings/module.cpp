// Python bindings of the renderer of Gaussians. Python checks arguments and names tensors in
// errors; the checks here only keep memory safe.
#include <nanobind/stl/optional.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/tuple.h>
#include <nanobind/stl/vector.h>

#include <cmath>
#include <optional>
#include <tuple>

#include "bindings/bindings.hpp"
#include "core/dispatch.hpp"
#include "project/baked_scene.hpp"

namespace splatpilot {
namespace {

// A frame as Python holds it, immutable.
struct RenderedFrame {
  std::shared_ptr<const Frame> frame;
  size_t splat_count;

  explicit RenderedFrame(std::shared_ptr<const Frame> rendered)
      : frame(std::move(rendered)), splat_count(frame->splat_count()) {}
};

void init_camera(CameraParameters* self, const Doubles<nb::shape<3, 3>>& K,
                 const Doubles<nb::shape<4, 4>>& X_CW, int width, int height, double near_plane,
                 double far_plane, double radius_clip, double eps2d, bool antialiased,
                 double max_depth, double merged_spread, int rows_above, int rows_below,
                 int distortion, const std::optional<Doubles<nb::shape<17>>>& lens) {
  require(width > 0 && height > 0 && width <= 32768 && height <= 32768,
          "the image size must be in [1, 32768] px");
  CameraParameters p{};
  p.width = width;
  p.height = height;
  p.near_plane = near_plane;
  p.far_plane = far_plane;
  p.radius_clip = radius_clip;
  p.eps2d = eps2d;
  p.antialiased = antialiased;
  p.max_depth = max_depth;
  p.merged_spread = merged_spread;
  require(rows_above >= 0 && rows_below >= 0, "the rows must be of the image");
  p.rows_above = rows_above;
  p.rows_below = rows_below;
  std::copy_n(K.data(), 9, p.K);
  std::copy_n(X_CW.data(), 16, p.X_CW);
  if (lens) {
    require(distortion >= 0 && distortion <= 2, "no such distortion");
    const double* n = lens->data();
    p.distortion.model = static_cast<DistortionModel>(distortion);
    std::copy_n(n, 6, p.distortion.radial);
    std::copy_n(n + 6, 2, p.distortion.tangential);
    p.distortion.max_squared_slope = static_cast<float>(n[8]);
    std::copy_n(n + 9, 2, p.min_slope);
    std::copy_n(n + 11, 2, p.max_slope);
    std::copy_n(n + 13, 2, p.min_side);
    std::copy_n(n + 15, 2, p.max_side);
  }
  new (self) CameraParameters(p);
}

// gsplat's meta, for the splats of a frame, in the order of the input. Opacities are rows of
// `given`, or those of the splats.
auto projected(Renderer& renderer, const RenderedFrame& rendered,
               const std::optional<Values>& given) {
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
    radii.data()[2 * i] = radius(s.extent_x);
    radii.data()[2 * i + 1] = radius(s.extent_y);
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

// Checks images of color (3 channels), depth (1) or both (4) and their alpha; returns the channels.
template <typename Image>
size_t check_images(const Image& image, const Image& alpha, int height, int width) {
  const size_t channels = image.shape(2);
  require(channels == 1 || channels == 3 || channels == 4, "an image has 1, 3 or 4 channels");
  check_size(image, height, width, channels);
  check_size(alpha, height, width, 1);
  return channels;
}

RenderedFrame render(Renderer& renderer, const Gaussians& gaussians,
                     const CameraParameters& parameters, DepthMode depth_mode,
                     const Background& background, const Output& image, const Output& alpha,
                     bool keep) {
  const size_t channels = check_images(image, alpha, parameters.height, parameters.width);
  Image out{};
  if (channels >= 3) out.color = image.data();
  if (channels != 3) out.depth = image.data() + channels - 1;
  out.color_stride = out.depth_stride = static_cast<int>(channels);
  out.depth_mode = depth_mode;
  out.alpha = alpha.data();
  std::copy_n(background.data(), 3, out.background);
  const Exclusive use(renderer);
  return RenderedFrame(renderer.render(gaussians.arrays(), make_camera(parameters), out, keep));
}

// The camera and the image of one view of a baked scene; without color, depth alone.
struct BakedView {
  Camera camera;
  Image image;

  BakedView(const BakedArrays& scene, CameraParameters parameters, float* color, float* depth,
            float* alpha, const float* background)
      : image{color, 3, depth, 1, DepthMode::kMedian, alpha, {}} {
    if (!color) parameters.eps2d = kDepthBlur;
    if (!depth) image.depth_mode = DepthMode::kExpected;
    const bool merged = scene.merged_geometry || scene.groups == 0;
    require(parameters.merged_spread == 0.0 || merged, "neighbors are not merged");
    camera = make_camera(parameters);
    camera.depth_alone = !color;
    std::copy_n(background, 3, image.background);
  }
};

void render_baked(const BakedScene& scene, Renderer& renderer, const Gaussians& moving,
                  const CameraParameters& parameters, const Background& background,
                  const std::optional<Output>& color, const std::optional<Output>& depth,
                  const std::optional<Output>& alpha) {
  require(color.has_value() == alpha.has_value(), "color and alpha are rendered together");
  const int height = parameters.height, width = parameters.width;
  require(color || depth, "no image");
  if (depth) check_size(*depth, height, width, 1);
  if (color) {
    check_size(*color, height, width, 3);
    check_size(*alpha, height, width, 1);
  }
  const BakedView view(scene.arrays(), parameters, color ? color->data() : nullptr,
                       depth ? depth->data() : nullptr, alpha ? alpha->data() : nullptr,
                       background.data());
  const Exclusive use(renderer);
  renderer.render(scene.arrays(), moving.arrays(), view.camera, view.image);
}

// Views of several scenes, each rendered by one thread.
void render_views(BatchRenderer& renderer, const std::vector<const BakedScene*>& scenes,
                  const std::vector<CameraParameters>& cameras, const Rows3& backgrounds,
                  const std::optional<Views>& color, const std::optional<Views>& depth,
                  const std::optional<Views>& alpha) {
  require(color.has_value() == alpha.has_value(), "color and alpha are rendered together");
  require(color || depth, "no image");
  const size_t count = scenes.size();
  require(cameras.size() == count, "scenes and cameras differ in number");
  require_rows(count, "scenes and backgrounds differ in number", backgrounds);
  const auto check = [&](const Views& images, size_t channels) {
    require_rows(count, "scenes and images differ in number", images);
    for (const CameraParameters& camera : cameras) {
      require(images.shape(1) == static_cast<size_t>(camera.height) &&
                  images.shape(2) == static_cast<size_t>(camera.width) &&
                  images.shape(3) == channels,
              "an image has the wrong shape");
    }
  };
  if (depth) check(*depth, 1);
  if (color) {
    check(*color, 3);
    check(*alpha, 1);
  }
  const Views& any = depth ? *depth : *color;
  const size_t pixels = any.shape(1) * any.shape(2);
  const nb::gil_scoped_release release;
  renderer.for_each(count, [&](Renderer& thread, size_t i) {
    const BakedView view(scenes[i]->arrays(), cameras[i],
                         color ? color->data() + 3 * pixels * i : nullptr,
                         depth ? depth->data() + pixels * i : nullptr,
                         alpha ? alpha->data() + pixels * i : nullptr, backgrounds.data() + 3 * i);
    thread.render(scenes[i]->arrays(), GaussianArrays{}, view.camera, view.image);
  });
}

void raster_backward(Renderer& renderer, const RenderedFrame& rendered, const Pixels& v_image,
                     const Pixels& v_alpha, const Pixels& image, const Pixels& alpha,
                     const Background& background, bool expected_depth,
                     const Writable<nb::shape<-1, 16>>& v_splats,
                     const Writable<nb::shape<-1, 2>>& v_means2d) {
  const Frame& frame = *rendered.frame;
  require(frame.kept, "the frame was not kept for a backward pass");
  const size_t channels = check_images(v_image, v_alpha, frame.camera.height, frame.camera.width);
  check_size(image, frame.camera.height, frame.camera.width, channels);
  check_size(alpha, frame.camera.height, frame.camera.width, 1);
  require_rows(rendered.splat_count, "splats and gradients differ in number", v_splats, v_means2d);
  ImageGradient g{};
  if (channels >= 3) g.color = v_image.data();
  if (channels != 3) g.depth = v_image.data() + channels - 1;
  if (channels != 3 && expected_depth) g.expected_depth = image.data() + channels - 1;
  g.stride = static_cast<int>(channels);
  g.alpha = v_alpha.data();
  g.rendered_alpha = alpha.data();
  std::copy_n(background.data(), 3, g.background);
  const Exclusive use(renderer);
  renderer.raster_backward(frame, g, reinterpret_cast<SplatGradient*>(v_splats.data()),
                           v_means2d.data());
}

OwnedArray<double, 5, 3> project_backward(Renderer& renderer, const RenderedFrame& rendered,
                                          const Gaussians& gaussians, const GradientRows& gradients,
                                          const Floats<nb::shape<-1, 16>>& v_splats,
                                          const Floats<nb::shape<-1, 2>>& v_means2d) {
  check_frame(*rendered.frame, gaussians.arrays());
  require_rows(rendered.splat_count, "splats and gradients differ in number", v_splats, v_means2d);
  const GaussianGradients out = gradients.arrays(gaussians.arrays());
  PoseSums sums;
  {
    const Exclusive use(renderer);
    sums = renderer.project_backward(*rendered.frame, gaussians.arrays(),
                                     reinterpret_cast<const SplatGradient*>(v_splats.data()),
                                     v_means2d.data(), out);
  }
  return pose_rows(sums);
}

}  // namespace

NB_MODULE(_native, m) {
  m.doc() = "Splat kernels for CPUs.";
  // Autograd graphs may hold frames until the interpreter ends, which is no leak.
  nb::set_leak_warnings(false);
  m.def("simd_levels", &simd_levels, "SIMD levels that this machine can run, widest first.");

  nb::enum_<DepthMode>(m, "DepthMode", "Depth of a pixel.")
      .value("ACCUMULATED", DepthMode::kAccumulated, "sum w z")
      .value("EXPECTED", DepthMode::kExpected, "sum w z / sum w")
      .value("MEDIAN", DepthMode::kMedian,
             "z where the transmittance of footprints without blur falls below one half, else 0");
  nb::class_<Renderer>(m, "Renderer", "Threads and scratch memory without influence on images.")
      .def(
          "__init__",
          [](Renderer* self, int threads, const std::string& simd) {
            new (self) Renderer(checked_threads(threads), simd);
          },
          "threads"_a, "simd"_a = "")
      .def_prop_ro("simd", [](const Renderer& r) { return std::string(r.kernels().name); });
  nb::class_<Gaussians>(m, "Gaussians", "Gaussians or surfels; colors are (N, K, 3).")
      .def(nb::init<Rows3, Rows4, Rows3, Values, Colors, int>(), nb::kw_only(), "means"_a,
           "quats"_a, "scales"_a, "opacities"_a, "colors"_a, "sh_degree"_a,
           "sh_degree -1: colors are given, K = 1.")
      .def(
          "are_valid",
          [](const Gaussians& gaussians, Renderer& renderer) {
            const Exclusive use(renderer);
            return renderer.are_valid(gaussians.arrays());
          },
          "renderer"_a, "Checks that every number can be rendered; subnormal scales may fail.");
  nb::class_<GradientRows>(m, "GaussianGradients", "Gradients of `Gaussians`, to be added to.")
      .def(nb::init<Rows3Out, Rows4Out, Rows3Out, ValuesOut, ColorsOut, bool, bool>(),
           nb::kw_only(), "means"_a, "quats"_a, "scales"_a, "opacities"_a, "colors"_a,
           "overwrite"_a, "overwrite_colors"_a, "Those to overwrite need no values.");
  nb::class_<CameraParameters>(m, "Camera", "A pinhole camera or one with a lens.")
      .def("__init__", &init_camera, nb::kw_only(), "K"_a, "X_CW"_a, "width"_a, "height"_a,
           "near_plane"_a, "far_plane"_a, "radius_clip"_a = 0.0, "eps2d"_a = 0.0,
           "antialiased"_a = false, "max_depth"_a = std::numeric_limits<double>::infinity(),
           "merged_spread"_a = 0.0, "rows_above"_a = 0, "rows_below"_a = 0, "distortion"_a = 0,
           "lens"_a = nb::none());
  nb::class_<RenderedFrame>(m, "Frame", "A rendered image, for its backward pass.")
      .def_ro("splat_count", &RenderedFrame::splat_count, "Number of visible Gaussians.");
  m.def("projected", &projected, "renderer"_a, "frame"_a, "opacities"_a.none(),
        "ids (n,), radii (n, 2), means (n, 2), depths (n,), conics (n, 3) and opacities (n,) of\n"
        "a frame's splats.");
  m.def("render", &render, "renderer"_a, "gaussians"_a, "camera"_a, nb::kw_only(), "depth_mode"_a,
        "background"_a, "image"_a, "alpha"_a, "keep"_a,
        "Writes color (3 channels), depth (1) or both (4) by the shape of image, and alpha. With\n"
        "keep, a backward pass can start from the frame.");
  m.def("raster_backward", &raster_backward, "renderer"_a, "frame"_a, nb::kw_only(), "v_image"_a,
        "v_alpha"_a, "image"_a, "alpha"_a, "background"_a, "expected_depth"_a, "v_splats"_a,
        "v_means2d"_a,
        "Writes the gradients of a frame's splats. v_image etc. are derivatives of the loss by\n"
        "image etc.");
  m.def("project_backward", &project_backward, "renderer"_a, "frame"_a, "gaussians"_a,
        "gradients"_a, nb::kw_only(), "v_splats"_a, "v_means2d"_a,
        "Writes the gradients of the frame's Gaussians. Returns (5, 3) those by R_CW with the\n"
        "camera's center fixed, by p_C and by p_W - center, summed over Gaussians.");

  nb::class_<BakedScene>(m, "BakedScene", "A static scene in the order and form of frames.")
      .def(
          "__init__",
          [](BakedScene* self, const Gaussians& gaussians) {
            require(gaussians.arrays().sh_degree >= 0, "a baked scene has spherical harmonics");
            new (self) BakedScene(gaussians.arrays());
          },
          "gaussians"_a)
      .def_prop_ro("count", &BakedScene::count)
      .def("merge_neighbors", &BakedScene::merge_neighbors,
           "Prepares images of cameras with a merged_spread.")
      .def(
          "recolored",
          [](const BakedScene& scene, const Colors& sh, int sh_degree) {
            require_rows(scene.count(), "colors and Gaussians differ in number", sh);
            require(sh_degree >= 0, "a baked scene has spherical harmonics");
            require_degree(sh_degree, sh.shape(1));
            return BakedScene(scene, sh.data(), static_cast<int>(sh.shape(1)), sh_degree);
          },
          "sh"_a, "sh_degree"_a, "The same Gaussians in other colors.");
  m.def(
      "render_baked", &render_baked, "scene"_a, "renderer"_a, "moving"_a, "camera"_a, nb::kw_only(),
      "background"_a, "color"_a.none(), "depth"_a.none(), "alpha"_a.none(),
      "Writes the median depth, color and alpha, unless they are None, of the scene and of moving\n"
      "Gaussians among it.");

  nb::class_<BatchRenderer>(m, "BatchRenderer", "Threads that render one image each.")
      .def(
          "__init__",
          [](BatchRenderer* self, int threads, const std::string& simd) {
            new (self) BatchRenderer(checked_threads(threads), simd);
          },
          "threads"_a, "simd"_a = "");
  m.def("render_views", &render_views, "renderer"_a, "scenes"_a, "cameras"_a, nb::kw_only(),
        "backgrounds"_a, "color"_a.none(), "depth"_a.none(), "alpha"_a.none(),
        "Writes the images of N cameras as render_baked does, camera i in scene i.");

  bind_surfels(m);
  bind_fitting(m);
  bind_shapes(m);
  bind_grids(m);
  bind_flight(m);
}

}  // namespace splatpilot
