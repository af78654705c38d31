// Python bindings of what fits Gaussians to images: losses, shapes, and the distance of
// Gaussians from the surface that a depth image shows.
#include <nanobind/stl/optional.h>
#include <nanobind/stl/string.h>

#include <cmath>
#include <optional>
#include <string>
#include <vector>

#include "bindings/bindings.hpp"
#include "core/dispatch.hpp"
#include "losses/fitting.hpp"
#include "losses/losses.hpp"

namespace splatpilot {
namespace {

using namespace nb::literals;
using Images = Floats<nb::ndim<4>>;
using ImagesOut = Writable<nb::ndim<4>>;
using Values = Floats<nb::ndim<1>>;
using ValuesOut = Writable<nb::ndim<1>>;
using DepthImage = Floats<nb::ndim<2>>;
using Indices = nb::ndarray<const int64_t, nb::ndim<1>, nb::c_contig, nb::device::cpu>;

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

const FittingKernels& fitting(const std::string& simd) { return *kernels(simd).fitting; }

void splat_shapes(const Means& log_scales, const Opacities& logit_opacities, const Values& smallest,
                  const Rows3& scales, const ValuesOut& opacities, const std::string& simd) {
  const size_t n = log_scales.shape(0);
  require(logit_opacities.size() == n && smallest.size() == n && scales.shape(0) == n &&
              opacities.size() == n,
          "arrays of Gaussians differ in length");
  const ShapeInput in{n,
                      log_scales.data(),
                      logit_opacities.data(),
                      smallest.data(),
                      scales.data(),
                      opacities.data()};
  const FittingKernels& kernels = fitting(simd);
  const nb::gil_scoped_release release;
  kernels.shapes(in);
}

void splat_shapes_backward(const Means& scales, const Opacities& opacities, const Values& smallest,
                           const Means& v_scales, const Opacities& v_opacities,
                           const Rows3& v_log_scales, const ValuesOut& v_logit_opacities,
                           const std::string& simd) {
  const size_t n = scales.shape(0);
  require(opacities.size() == n && smallest.size() == n && v_scales.shape(0) == n &&
              v_opacities.size() == n && v_log_scales.shape(0) == n &&
              v_logit_opacities.size() == n,
          "arrays of Gaussians differ in length");
  const ShapeGradientInput in{n,
                              scales.data(),
                              opacities.data(),
                              smallest.data(),
                              v_scales.data(),
                              v_opacities.data(),
                              v_log_scales.data(),
                              v_logit_opacities.data()};
  const FittingKernels& kernels = fitting(simd);
  const nb::gil_scoped_release release;
  kernels.shapes_backward(in);
}

// A point of a Gaussian that belongs to what is seen.
struct SurfacePoint {
  size_t gaussian, draw;
  float z, truth;  // [m]
};

// The vector v turned by the unit quaternion (w, q), or with w negated turned back.
void turn(float w, const float* q, const float* v, float* turned) {
  const float c[3] = {2 * (q[1] * v[2] - q[2] * v[1]), 2 * (q[2] * v[0] - q[0] * v[2]),
                      2 * (q[0] * v[1] - q[1] * v[0])};
  turned[0] = v[0] + w * c[0] + q[1] * c[2] - q[2] * c[1];
  turned[1] = v[1] + w * c[1] + q[2] * c[0] - q[0] * c[2];
  turned[2] = v[2] + w * c[2] + q[0] * c[1] - q[1] * c[0];
}

// The gradient by an unnormalized quaternion of v . R(q) u, added to `gradient`.
void add_quaternion_gradient(const float* quat, float inverse_norm, const float* u, const float* v,
                             float* gradient) {
  const float w = quat[0] * inverse_norm, x = quat[1] * inverse_norm, y = quat[2] * inverse_norm,
              z = quat[3] * inverse_norm;
  // R u = (w^2 - q.q) u + 2 (q.u) q + 2 w (q x u) for a unit quaternion.
  const float uv = u[0] * v[0] + u[1] * v[1] + u[2] * v[2];
  const float qu = x * u[0] + y * u[1] + z * u[2], qv = x * v[0] + y * v[1] + z * v[2];
  const float across[3] = {u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2],
                           u[0] * v[1] - u[1] * v[0]};  // q . (u x v) = v . (q x u)
  const float g[4] = {2 * (w * uv + x * across[0] + y * across[1] + z * across[2]),
                      2 * (-x * uv + qu * v[0] + qv * u[0] + w * across[0]),
                      2 * (-y * uv + qu * v[1] + qv * u[1] + w * across[1]),
                      2 * (-z * uv + qu * v[2] + qv * u[2] + w * across[2])};
  const float along = w * g[0] + x * g[1] + y * g[2] + z * g[3];
  gradient[0] += (g[0] - along * w) * inverse_norm;
  gradient[1] += (g[1] - along * x) * inverse_norm;
  gradient[2] += (g[2] - along * y) * inverse_norm;
  gradient[3] += (g[3] - along * z) * inverse_norm;
}

double surface_loss(const Means& means, const Quats& quats, const Means& scales,
                    const Indices& seen, const Means& draws, const Floats<nb::shape<4, 4>>& X_CW,
                    const Floats<nb::shape<3, 3>>& K, const DepthImage& depth, float reach,
                    float nearest, float far, const Rows3& v_means, const Rows4& v_quats,
                    const Rows3& v_scales) {
  const size_t n = means.shape(0), count = seen.size();
  require(quats.shape(0) == n && scales.shape(0) == n && v_means.shape(0) == n &&
              v_quats.shape(0) == n && v_scales.shape(0) == n,
          "arrays of Gaussians differ in length");
  require(draws.shape(0) == count, "there must be a draw for each Gaussian that is seen");
  for (size_t i = 0; i < count; ++i) {
    require(seen(i) >= 0 && static_cast<size_t>(seen(i)) < n, "a Gaussian is seen that is not");
  }
  const nb::gil_scoped_release release;
  const float* X = X_CW.data();
  const float *k = K.data(), *truths = depth.data();
  const auto height = static_cast<float>(depth.shape(0));
  const auto width = static_cast<float>(depth.shape(1));
  const auto inverse_norm = [&](size_t g) {
    const float* q = quats.data() + 4 * g;
    const float norm = std::sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]);
    return 1.0f / std::max(norm, 1e-12f);
  };
  const auto offset_of = [&](size_t g, size_t i, float* offset) {
    for (int a = 0; a < 3; ++a) offset[a] = draws.data()[3 * i + a] * scales.data()[3 * g + a];
  };
  thread_local std::vector<SurfacePoint> near;
  near.clear();
  double sum = 0.0;
  for (size_t i = 0; i < count; ++i) {
    const auto g = static_cast<size_t>(seen(i));
    const float* quat = quats.data() + 4 * g;
    const float s = inverse_norm(g);
    const float axis[3] = {quat[1] * s, quat[2] * s, quat[3] * s};
    float offset[3], p_C[3];
    offset_of(g, i, offset);
    float p_W[3];
    turn(quat[0] * s, axis, offset, p_W);
    for (int a = 0; a < 3; ++a) p_W[a] += means.data()[3 * g + a];
    for (int a = 0; a < 3; ++a) {
      const float* row = X + 4 * a;
      p_C[a] = row[0] * p_W[0] + row[1] * p_W[1] + row[2] * p_W[2] + row[3];
    }
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
    const float slope = (point.z > point.truth ? share : -share) / point.z;
    const float v_p[3] = {slope * X[8], slope * X[9], slope * X[10]};
    const float* quat = quats.data() + 4 * point.gaussian;
    const float s = inverse_norm(point.gaussian);
    const float axis[3] = {quat[1] * s, quat[2] * s, quat[3] * s};
    float offset[3], v_offset[3];
    offset_of(point.gaussian, point.draw, offset);
    turn(-quat[0] * s, axis, v_p, v_offset);
    for (int a = 0; a < 3; ++a) {
      v_means.data()[3 * point.gaussian + a] += v_p[a];
      v_scales.data()[3 * point.gaussian + a] += draws.data()[3 * point.draw + a] * v_offset[a];
    }
    add_quaternion_gradient(quat, s, offset, v_p, v_quats.data() + 4 * point.gaussian);
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
        "Mean |log(z / depth)| of points drawn from the Gaussians that are seen; adds gradients.");
  m.def("photometric_loss", &photometric_loss, nb::kw_only(), "rendered"_a, "target"_a,
        "ssim_weight"_a, "gradient"_a.none(), "simd"_a = "",
        "(1 - w) L1 + w (1 - SSIM) of images (N, H, W, C); writes the gradient unless None.");
  m.def(
      "log_depth_loss", &log_depth_loss, nb::kw_only(), "rendered"_a, "depth"_a, "weights"_a.none(),
      "epsilon"_a, "far"_a, "gradient"_a.none(), "simd"_a = "",
      "Mean weighted |log(rendered / depth)| over valid pixels; writes the gradient unless None.");
}

}  // namespace splatpilot
