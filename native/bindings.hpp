// What the files of the Python module share.
#pragma once

#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <initializer_list>
#include <stdexcept>

#include "renderer.hpp"

namespace splatpilot {

namespace nb = nanobind;
template <typename... Shape>
using Floats = nb::ndarray<const float, Shape..., nb::c_contig, nb::device::cpu>;
template <typename... Shape>
using Doubles = nb::ndarray<const double, Shape..., nb::c_contig, nb::device::cpu>;
using Output = nb::ndarray<float, nb::ndim<3>, nb::c_contig, nb::device::cpu>;

using Means = Floats<nb::shape<-1, 3>>;
using Quats = Floats<nb::shape<-1, 4>>;
using Opacities = Floats<nb::ndim<1>>;
using Colors = Floats<nb::shape<-1, -1, 3>>;

inline void require(bool condition, const char* message) {
  if (!condition) throw std::invalid_argument(message);
}

inline GaussianArrays gaussian_arrays(const Means& means, const Quats& quats, const Means& scales,
                                      const Opacities& opacities, const Colors& colors,
                                      int sh_degree) {
  const size_t n = means.shape(0);
  require(quats.shape(0) == n && scales.shape(0) == n && opacities.shape(0) == n &&
              colors.shape(0) == n,
          "arrays of Gaussians differ in length");
  require(n < (size_t{1} << 32) - kChunkSize, "too many Gaussians");
  const int coefficients = static_cast<int>(colors.shape(1));
  require(sh_degree <= 3 && coefficients >= std::max(1, (sh_degree + 1) * (sh_degree + 1)),
          "too few spherical-harmonic coefficients for the degree");
  return {n,         means.data(), quats.data(), scales.data(), opacities.data(), colors.data(),
          sh_degree, coefficients};
}

inline Camera camera_from(const Doubles<nb::shape<3, 3>>& K, const Doubles<nb::shape<4, 4>>& X_CW,
                          int width, int height, double near_plane, double far_plane,
                          double radius_clip, double eps2d, bool antialiased = false) {
  require(width > 0 && height > 0, "the image must have pixels");
  require(width <= 32768 && height <= 32768, "the image is larger than 32768 pixels");
  CameraParameters p{width, height, {}, {}, near_plane, far_plane, radius_clip, eps2d, antialiased};
  std::copy_n(K.data(), 9, p.K);
  std::copy_n(X_CW.data(), 16, p.X_CW);
  return make_camera(p);
}

inline void check_size(const Output& out, int width, int height, size_t channels) {
  require(out.shape(0) == static_cast<size_t>(height) &&
              out.shape(1) == static_cast<size_t>(width) && out.shape(2) == channels,
          "an output array has the wrong shape");
}

// Where an image of colour (3 channels), depth (1) or both (4) and its alpha are to be written.
inline Image output_image(const Output& image, const Output& alpha, int width, int height,
                          bool expected_depth, const Floats<nb::shape<3>>& background) {
  const size_t channels = image.shape(2);
  require(channels == 1 || channels == 3 || channels == 4, "an image has 1, 3 or 4 channels");
  check_size(image, width, height, channels);
  check_size(alpha, width, height, 1);
  Image out{};
  if (channels >= 3) out.color = image.data();
  if (channels != 3) out.depth = image.data() + channels - 1;
  out.color_stride = out.depth_stride = static_cast<int>(channels);
  out.expected_depth = expected_depth;
  out.alpha = alpha.data();
  std::copy_n(background.data(), 3, out.background);
  return out;
}

// A numpy array that owns its memory, which is not initialised.
template <typename T>
nb::ndarray<nb::numpy, T> new_array(std::initializer_list<size_t> shape) {
  size_t size = 1;
  for (const size_t n : shape) size *= n;
  auto* values = new T[size];
  return {values, shape,
          nb::capsule(values, [](void* p) noexcept { delete[] static_cast<T*>(p); })};
}

// Pixels, rounded up; bounded, so that it fits an integer.
inline int32_t radius_of(float extent) {
  return static_cast<int32_t>(std::ceil(std::min(extent, 1073741824.0f)));
}

// Adds what the backward pass needs to the module.
void bind_gradients(nb::module_& m);
// Adds the renderer of surfels.
void bind_surfels(nb::module_& m);
// Adds the rendering of projected Gaussians.
void bind_projected(nb::module_& m);

}  // namespace splatpilot
