// Types that the files of the Python module share.
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
using namespace nb::literals;

template <typename T, typename... Shape>
using Array = nb::ndarray<T, Shape..., nb::c_contig, nb::device::cpu>;
template <typename... Shape>
using Floats = Array<const float, Shape...>;
template <typename... Shape>
using Doubles = Array<const double, Shape...>;
// An array that a function writes. Python must pass the exact type: a converted copy would be
// written instead.
template <typename T, typename... Shape>
struct Written : Array<T, Shape...> {
  Written() = default;
  explicit Written(const Array<T, Shape...>& array) : Array<T, Shape...>(array) {}
};
template <typename... Shape>
using Writable = Written<float, Shape...>;
using Indices = Array<const int64_t, nb::ndim<1>>;
using Values = Floats<nb::ndim<1>>;
using ValuesOut = Writable<nb::ndim<1>>;
using Pixels = Floats<nb::ndim<3>>;
using Output = Writable<nb::ndim<3>>;
using Views = Writable<nb::ndim<4>>;
using Background = Floats<nb::shape<3>>;
using Rows3 = Floats<nb::shape<-1, 3>>;
using Rows4 = Floats<nb::shape<-1, 4>>;
using Rows3Out = Writable<nb::shape<-1, 3>>;
using Rows4Out = Writable<nb::shape<-1, 4>>;
using Colors = Floats<nb::shape<-1, -1, 3>>;
using ColorsOut = Writable<nb::shape<-1, -1, 3>>;

inline void require(bool condition, const char* message) {
  if (!condition) throw std::invalid_argument(message);
}

// Checks that arrays have n rows.
template <typename... Arrays>
void require_rows(size_t n, const char* message, const Arrays&... arrays) {
  require(((arrays.shape(0) == n) && ...), message);
}

inline int checked_threads(int threads) {
  require(threads >= 1 && threads <= 1024, "threads must be in [1, 1024]");
  return threads;
}

inline void require_degree(int sh_degree, size_t coefficients) {
  require(sh_degree <= 3 &&
              static_cast<int>(coefficients) >= std::max(1, (sh_degree + 1) * (sh_degree + 1)),
          "too few spherical-harmonic coefficients for the degree");
}

// Gaussians or surfels of Python, whose arrays it keeps alive.
class Gaussians {
 public:
  Gaussians(Rows3 means, Rows4 quats, Rows3 scales, Values opacities, Colors colors, int sh_degree)
      : means_(means), quats_(quats), scales_(scales), opacities_(opacities), colors_(colors) {
    const size_t n = means.shape(0);
    require_rows(n, "arrays of Gaussians differ in length", quats, scales, opacities, colors);
    require(n < (size_t{1} << 32) - kChunkSize, "too many Gaussians");
    require_degree(sh_degree, colors.shape(1));
    arrays_ = {n,
               means.data(),
               quats.data(),
               scales.data(),
               opacities.data(),
               colors.data(),
               sh_degree,
               static_cast<int>(colors.shape(1))};
  }
  const GaussianArrays& arrays() const { return arrays_; }

 private:
  Rows3 means_;
  Rows4 quats_;
  Rows3 scales_;
  Values opacities_;
  Colors colors_;
  GaussianArrays arrays_;
};

// The arrays of gradients of Gaussians.
struct GradientRows {
  Rows3Out means;
  Rows4Out quats;
  Rows3Out scales;
  ValuesOut opacities;
  ColorsOut colors;
  bool overwrite, overwrite_colors;

  GaussianGradients arrays(const GaussianArrays& g) const {
    const char* message = "gradients and Gaussians differ in shape";
    require_rows(g.count, message, means, quats, scales, opacities, colors);
    require(colors.shape(1) == static_cast<size_t>(g.sh_coefficients), message);
    return {means.data(),  quats.data(), scales.data(),   opacities.data(),
            colors.data(), overwrite,    overwrite_colors};
  }
};

// Use of a renderer by one thread at a time, without Python's lock.
struct Exclusive {
  nb::gil_scoped_release release;
  std::scoped_lock<std::mutex> lock;  // released before Python's is taken

  explicit Exclusive(Renderer& renderer) : lock(renderer.mutex()) {}
};

// Checks that `image` is (height, width, channels).
template <typename Image>
void check_size(const Image& image, int height, int width, size_t channels) {
  require(image.shape(0) == static_cast<size_t>(height) &&
              image.shape(1) == static_cast<size_t>(width) && image.shape(2) == channels,
          "an image has the wrong shape");
}

// Checks that a kept frame is one of `gaussians`.
inline void check_frame(const Frame& frame, const GaussianArrays& gaussians) {
  require(frame.kept, "the frame was not kept for a backward pass");
  require(gaussians.count == frame.gaussians, "these are not the Gaussians of the frame");
}

// A numpy array that owns its memory; -1 is an axis known only at run time.
template <typename T, nb::ssize_t... kShape>
using OwnedArray = nb::ndarray<nb::numpy, T, nb::shape<kShape...>>;

// `n` replaces -1. The values are not initialized.
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

// Pixels, rounded up, and clamped to fit an integer.
inline int32_t radius(float extent) {
  return static_cast<int32_t>(std::ceil(std::min(extent, 1073741824.0f)));
}

// Functions that bind the contents of their files.
void bind_surfels(nb::module_& m);
void bind_fitting(nb::module_& m);
void bind_shapes(nb::module_& m);
void bind_grids(nb::module_& m);
void bind_flight(nb::module_& m);

}  // namespace splatpilot

template <typename T, typename... Shape>
struct nanobind::detail::type_caster<splatpilot::Written<T, Shape...>> {
  using Caster = make_caster<splatpilot::Array<T, Shape...>>;
  using Array = splatpilot::Written<T, Shape...>;
  NB_TYPE_CASTER(Array, Caster::Name)

  bool from_python(handle source, uint32_t flags, cleanup_list* cleanup) noexcept {
    Caster caster;
    const uint32_t exact = flags & ~static_cast<uint32_t>(cast_flags::convert);
    if (!caster.from_python(source, exact, cleanup)) return false;
    value = Array(caster.value);
    return true;
  }
};
