// What the files of the Python module share.
#pragma once

#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <memory>
#include <mutex>
#include <stdexcept>

#include "raster/renderer.hpp"

namespace splatpilot {

namespace nb = nanobind;
template <typename... Shape>
using Floats = nb::ndarray<const float, Shape..., nb::c_contig, nb::device::cpu>;
template <typename... Shape>
using Doubles = nb::ndarray<const double, Shape..., nb::c_contig, nb::device::cpu>;
template <typename... Shape>
using Writable = nb::ndarray<float, Shape..., nb::c_contig, nb::device::cpu>;
using Pixels = Floats<nb::ndim<3>>;
using Output = Writable<nb::ndim<3>>;

using Means = Floats<nb::shape<-1, 3>>;
using Quats = Floats<nb::shape<-1, 4>>;
using Opacities = Floats<nb::ndim<1>>;
using Colors = Floats<nb::shape<-1, -1, 3>>;
// Gradients of these.
using Rows3 = Writable<nb::shape<-1, 3>>;
using Rows4 = Writable<nb::shape<-1, 4>>;
using ColorRows = Writable<nb::shape<-1, -1, 3>>;
using Intrinsics = Doubles<nb::shape<3, 3>>;
using Pose = Doubles<nb::shape<4, 4>>;

inline void require(bool condition, const char* message) {
  if (!condition) throw std::invalid_argument(message);
}

// A frame as Python holds it: nothing there may change it.
struct RenderedFrame {
  std::shared_ptr<const Frame> frame;
  size_t splat_count;

  explicit RenderedFrame(std::shared_ptr<const Frame> rendered)
      : frame(std::move(rendered)), splat_count(frame->splat_count()) {}
};

// Use of a renderer by one thread at a time, which others of Python do not wait for.
struct Exclusive {
  nb::gil_scoped_release release;
  std::scoped_lock<std::mutex> lock;  // given back before Python's own is taken

  explicit Exclusive(Renderer& renderer) : lock(renderer.mutex()) {}
};

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

inline void require_rows(const GaussianArrays& g, const Rows3& v_means, const Rows4& v_quats,
                         const Rows3& v_scales, const Writable<nb::ndim<1>>& v_opacities,
                         const ColorRows& v_colors) {
  require(v_means.shape(0) == g.count && v_quats.shape(0) == g.count &&
              v_scales.shape(0) == g.count && v_opacities.shape(0) == g.count &&
              v_colors.shape(0) == g.count &&
              v_colors.shape(1) == static_cast<size_t>(g.sh_coefficients),
          "gradients and Gaussians differ in shape");
}

inline CameraParameters camera_parameters(const Intrinsics& K, const Pose& X_CW, int width,
                                          int height, double near_plane, double far_plane,
                                          double radius_clip, double eps2d) {
  require(width > 0 && height > 0 && width <= 32768 && height <= 32768,
          "the image must have pixels, and at most 32768 a side");
  CameraParameters p{};
  p.width = width;
  p.height = height;
  p.near_plane = near_plane;
  p.far_plane = far_plane;
  p.radius_clip = radius_clip;
  p.eps2d = eps2d;
  std::copy_n(K.data(), 9, p.K);
  std::copy_n(X_CW.data(), 16, p.X_CW);
  return p;
}

// Whether `image` is (height, width, channels).
template <typename Array>
void check_size(const Array& image, const Camera& camera, size_t channels) {
  require(image.shape(0) == static_cast<size_t>(camera.height) &&
              image.shape(1) == static_cast<size_t>(camera.width) && image.shape(2) == channels,
          "an image has the wrong shape");
}

// Where an image of color (3 channels), depth (1) or both (4) and its alpha are to be written.
inline Image output_image(const Output& image, const Output& alpha, const Camera& camera,
                          DepthMode depth_mode, const Floats<nb::shape<3>>& background) {
  const size_t channels = image.shape(2);
  require(channels == 1 || channels == 3 || channels == 4, "an image has 1, 3 or 4 channels");
  check_size(image, camera, channels);
  check_size(alpha, camera, 1);
  Image out{};
  if (channels >= 3) out.color = image.data();
  if (channels != 3) out.depth = image.data() + channels - 1;
  out.color_stride = out.depth_stride = static_cast<int>(channels);
  out.depth_mode = depth_mode;
  out.alpha = alpha.data();
  std::copy_n(background.data(), 3, out.background);
  return out;
}

// A numpy array that owns its memory; -1 stands for what is known only at run time.
template <typename T, nb::ssize_t... kShape>
using OwnedArray = nb::ndarray<nb::numpy, T, nb::shape<kShape...>>;

// `n` takes the place of -1. The values are not initialized.
template <typename T, nb::ssize_t... kShape>
OwnedArray<T, kShape...> new_array(size_t n = 0) {
  const size_t shape[] = {(kShape == -1 ? n : static_cast<size_t>(kShape))...};
  size_t size = 1;
  for (const size_t length : shape) size *= length;
  auto values = std::make_unique_for_overwrite<T[]>(size);
  nb::capsule owner(values.get(), [](void* p) noexcept { delete[] static_cast<T*>(p); });
  return {values.release(), sizeof...(kShape), shape, owner};
}

inline OwnedArray<double, 5, 3> pose_rows(const PoseSums& sums) {
  OwnedArray<double, 5, 3> rows = new_array<double, 5, 3>();
  std::copy_n(sums.values, 15, rows.data());
  return rows;
}

// Pixels, rounded up; bounded, so that it fits an integer.
inline int32_t radius_of(float extent) {
  return static_cast<int32_t>(std::ceil(std::min(extent, 1073741824.0f)));
}

// Add to the module what their files bind.
void bind_baked(nb::module_& m);
void bind_surfels(nb::module_& m);
void bind_fitting(nb::module_& m);
void bind_shapes(nb::module_& m);
void bind_grids(nb::module_& m);

}  // namespace splatpilot
