// Python bindings of the losses.
#include <nanobind/stl/optional.h>
#include <nanobind/stl/string.h>

#include <optional>
#include <string>
#include <vector>

#include "bindings/bindings.hpp"
#include "core/dispatch.hpp"
#include "losses/losses.hpp"

namespace splatpilot {
namespace {

using namespace nb::literals;
using Images = Floats<nb::ndim<4>>;
using ImagesOut = Writable<nb::ndim<4>>;
using Values = Floats<nb::ndim<1>>;
using ValuesOut = Writable<nb::ndim<1>>;

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

}  // namespace

void bind_losses(nb::module_& m) {
  m.def("photometric_loss", &photometric_loss, nb::kw_only(), "rendered"_a, "target"_a,
        "ssim_weight"_a, "gradient"_a.none(), "simd"_a = "",
        "(1 - w) L1 + w (1 - SSIM) of images (N, H, W, C); writes the gradient unless None.");
  m.def(
      "log_depth_loss", &log_depth_loss, nb::kw_only(), "rendered"_a, "depth"_a, "weights"_a.none(),
      "epsilon"_a, "far"_a, "gradient"_a.none(), "simd"_a = "",
      "Mean weighted |log(rendered / depth)| over valid pixels; writes the gradient unless None.");
}

}  // namespace splatpilot
