// Python bindings of losses, of the parameters of Gaussians, and of the distance of Gaussians from
// the surface in a depth image.
#include <nanobind/stl/optional.h>
#include <nanobind/stl/string.h>

#include <cmath>
#include <optional>
#include <string>
#include <vector>

#include "bindings/bindings.hpp"
#include "core/dispatch.hpp"
#include "losses/losses.hpp"

#define SIMD_LEVEL baseline
#include "core/vectors.hpp"

namespace splatpilot {
namespace {

using Images = Floats<nb::ndim<4>>;
using ImagesOut = Writable<nb::ndim<4>>;
using DepthImage = Floats<nb::ndim<2>>;
using Vector = SIMD_LEVEL::Vector3<float>;

double photometric_loss(const Images& rendered, const Images& target, float ssim_weight,
                        const std::optional<ImagesOut>& gradient, const std::string& simd) {
  for (size_t axis = 0; axis < 4; ++axis) {
    require(rendered.shape(axis) == target.shape(axis), "images differ in shape");
    require(!gradient || rendered.shape(axis) == gradient->shape(axis),
            "the gradient differs in shape");
    require(axis == 0 || (rendered.shape(axis) > 0 && rendered.shape(axis) <= 32768),
            "an image has no pixels, or more than 32768 along a side");
  }
  require(rendered.shape(0) > 0, "there is no image");
  const LossKernels& kernels = *splatpilot::kernels(simd).losses;
  const double count = static_cast<double>(rendered.size());
  PhotometricInput in{};
  in.height = static_cast<int>(rendered.shape(1));
  in.width = static_cast<int>(rendered.shape(2));
  in.channels = static_cast<int>(rendered.shape(3));
  in.l1_scale = static_cast<float>((1.0 - ssim_weight) / count);
  in.ssim_scale = static_cast<float>(-ssim_weight / count);
  const size_t size = rendered.size() / rendered.shape(0);

  const nb::gil_scoped_release release;
  thread_local std::vector<float> scratch;
  scratch.resize(kernels.photometric_scratch(in.width, in.channels));
  in.scratch = scratch.data();
  PhotometricSums sums = {0.0, 0.0};
  for (size_t i = 0; i < rendered.shape(0); ++i) {
    in.rendered = rendered.data() + i * size;
    in.target = target.data() + i * size;
    in.gradient = gradient ? gradient->data() + i * size : nullptr;
    const PhotometricSums image = kernels.photometric(in);
    sums.l1 += image.l1;
    sums.dissimilarity += image.dissimilarity;
  }
  return ((1.0 - ssim_weight) * sums.l1 + ssim_weight * sums.dissimilarity) / count;
}

double log_depth_loss(const Values& rendered, const Values& depth,
                      const std::optional<Values>& weights, float epsilon, float far,
                      const std::optional<ValuesOut>& gradient, const std::string& simd) {
  const size_t count = rendered.size();
  require(depth.size() == count && (!weights || weights->size() == count) &&
              (!gradient || gradient->size() == count),
          "depth images differ in size");
  const LossKernels& kernels = *splatpilot::kernels(simd).losses;
  const LogDepthInput in{rendered.data(), depth.data(), weights ? weights->data() : nullptr,  count,
                         epsilon,         far,          gradient ? gradient->data() : nullptr};
  const nb::gil_scoped_release release;
  return kernels.log_depth(in);
}

void splat_shapes(const Rows3& log_scales, const Values& logit_opacities, const Values& smallest,
                  const Rows3Out& scales, const ValuesOut& opacities, const std::string& simd) {
  const size_t n = log_scales.shape(0);
  require_rows(n, "arrays of Gaussians differ in length", logit_opacities, smallest, scales,
               opacities);
  const ShapeInput in{n,
                      log_scales.data(),
                      logit_opacities.data(),
                      smallest.data(),
                      scales.data(),
                      opacities.data()};
  const LossKernels& kernels = *splatpilot::kernels(simd).losses;
  const nb::gil_scoped_release release;
  kernels.shapes(in);
}

void splat_shapes_backward(const Rows3& scales, const Values& opacities, const Values& smallest,
                           const Rows3& v_scales, const Values& v_opacities,
                           const Rows3Out& v_log_scales, const ValuesOut& v_logit_opacities,
                           const std::string& simd) {
  const size_t n = scales.shape(0);
  require_rows(n, "arrays of Gaussians differ in length", opacities, smallest, v_scales,
               v_opacities, v_log_scales, v_logit_opacities);
  const ShapeGradientInput in{n,
                              scales.data(),
                              opacities.data(),
                              smallest.data(),
                              v_scales.data(),
                              v_opacities.data(),
                              v_log_scales.data(),
                              v_logit_opacities.data()};
  const LossKernels& kernels = *splatpilot::kernels(simd).losses;
  const nb::gil_scoped_release release;
  kernels.shapes_backward(in);
}

// A point of a Gaussian at a valid depth.
struct SurfacePoint {
  size_t gaussian, draw;
  float z, truth;  // [m]
};

double surface_loss(const Rows3& means, const Rows4& quats, const Rows3& scales,
                    const Indices& seen, const Rows3& draws, const Floats<nb::shape<4, 4>>& X_CW,
                    const Floats<nb::shape<3, 3>>& K, const DepthImage& depth, float reach,
                    float nearest, float far, const Rows3Out& v_means, const Rows4Out& v_quats,
                    const Rows3Out& v_scales) {
  const size_t n = means.shape(0), count = seen.size();
  require_rows(n, "arrays of Gaussians differ in length", quats, scales, v_means, v_quats,
               v_scales);
  require_rows(count, "visible Gaussians and draws differ in number", draws);
  for (size_t i = 0; i < count; ++i) {
    require(seen(i) >= 0 && static_cast<size_t>(seen(i)) < n, "no such Gaussian");
  }
  const nb::gil_scoped_release release;
  const float *X = X_CW.data(), *k = K.data(), *truths = depth.data();
  const auto height = static_cast<float>(depth.shape(0));
  const auto width = static_cast<float>(depth.shape(1));
  const auto vector = [](const float* p, size_t row) -> Vector {
    return {p[3 * row], p[3 * row + 1], p[3 * row + 2]};
  };
  const auto offset = [&](size_t g, size_t i) -> Vector {
    const Vector draw = vector(draws.data(), i), scale = vector(scales.data(), g);
    return {draw.x * scale.x, draw.y * scale.y, draw.z * scale.z};
  };
  thread_local std::vector<SurfacePoint> near;
  near.clear();
  double sum = 0.0;
  for (size_t i = 0; i < count; ++i) {
    const auto g = static_cast<size_t>(seen(i));
    Vector axes[3];
    SIMD_LEVEL::rotation_columns(quats.data() + 4 * g, axes);
    const Vector a = offset(g, i);
    const Vector p_W = vector(means.data(), g) + (a.x * axes[0] + (a.y * axes[1] + a.z * axes[2]));
    float p_C[3];
    for (int row = 0; row < 3; ++row) p_C[row] = dot(X + 4 * row, p_W) + X[4 * row + 3];
    if (!(p_C[2] > nearest)) continue;
    const float x = p_C[0] / p_C[2], y = p_C[1] / p_C[2];
    const float u = std::floor(k[0] * x + k[1] * y + k[2]);
    const float v = std::floor(k[3] * x + k[4] * y + k[5]);
    if (!(u >= 0 && u < width && v >= 0 && v < height)) continue;
    const float truth = truths[static_cast<size_t>(v) * depth.shape(1) + static_cast<size_t>(u)];
    if (!(truth > 0 && truth < far && std::abs(p_C[2] - truth) < reach * truth)) continue;
    sum += std::abs(std::log(p_C[2] / truth));
    near.push_back({g, i, p_C[2], truth});
  }
  if (near.empty()) return 0.0;
  const float share = 1.0f / static_cast<float>(near.size());
  for (const SurfacePoint& point : near) {
    if (point.z == point.truth) continue;
    const size_t g = point.gaussian;
    const float slope = (point.z > point.truth ? share : -share) / point.z;
    const Vector v_p = {slope * X[8], slope * X[9], slope * X[10]};
    const float v_mean[3] = {v_p.x, v_p.y, v_p.z};
    Vector axes[3];
    SIMD_LEVEL::rotation_columns(quats.data() + 4 * g, axes);
    for (int a = 0; a < 3; ++a) {
      v_means.data()[3 * g + a] += v_mean[a];
      v_scales.data()[3 * g + a] += draws.data()[3 * point.draw + a] * dot(axes[a], v_p);
    }
    const Vector a = offset(g, point.draw);
    float v_quat[4];
    SIMD_LEVEL::quaternion_gradient(quats.data() + 4 * g, a.x * v_p, a.y * v_p, a.z * v_p, v_quat);
    for (int c = 0; c < 4; ++c) v_quats.data()[4 * g + c] += v_quat[c];
  }
  return sum / static_cast<double>(near.size());
}

}  // namespace

void bind_fitting(nb::module_& m) {
  m.def("splat_shapes", &splat_shapes, nb::kw_only(), "log_scales"_a, "logit_opacities"_a,
        "smallest"_a, "scales"_a, "opacities"_a, "simd"_a = "",
        "Writes sqrt(exp(2 log_scales) + smallest^2) and sigmoid(logit_opacities).");
  m.def("splat_shapes_backward", &splat_shapes_backward, nb::kw_only(), "scales"_a, "opacities"_a,
        "smallest"_a, "v_scales"_a, "v_opacities"_a, "v_log_scales"_a, "v_logit_opacities"_a,
        "simd"_a = "", "Writes the gradients of the inputs of splat_shapes.");
  m.def("surface_loss", &surface_loss, nb::kw_only(), "means"_a, "quats"_a, "scales"_a, "seen"_a,
        "draws"_a, "X_CW"_a, "K"_a, "depth"_a, "reach"_a, "nearest"_a, "far"_a, "v_means"_a,
        "v_quats"_a, "v_scales"_a,
        "Mean |log(z / depth)| of points drawn from visible Gaussians; adds gradients.");
  m.def("photometric_loss", &photometric_loss, nb::kw_only(), "rendered"_a, "target"_a,
        "ssim_weight"_a, "gradient"_a.none(), "simd"_a = "",
        "(1 - w) L1 + w (1 - SSIM) of images (N, H, W, C); writes the gradient unless None.");
  m.def(
      "log_depth_loss", &log_depth_loss, nb::kw_only(), "rendered"_a, "depth"_a, "weights"_a.none(),
      "epsilon"_a, "far"_a, "gradient"_a.none(), "simd"_a = "",
      "Mean weighted |log(rendered / depth)| over valid pixels; writes the gradient unless None.");
}

}  // namespace splatpilot
