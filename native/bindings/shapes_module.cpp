// Python bindings of worlds of analytic shapes, and of their distance field in double precision.
#include <nanobind/stl/optional.h>

#include <cstdint>
#include <limits>
#include <optional>

#include "bindings/casting_bindings.hpp"

// The distances below are compiled for every machine.
#define SIMD_LEVEL baseline
#include "fields/shape_distances.hpp"

namespace splatpilot {
namespace {

using Rows = Floats<nb::shape<-1, kShapeSize>>;
using DoubleRows = Doubles<nb::shape<-1, kShapeSize>>;
using Kinds = Array<const uint8_t, nb::ndim<1>>;

// Center and half size along each axis of a body's bounding box, enlarged for rounding.
void bound(uint8_t kind, const float* s, float* center, float* half) {
  for (int k = 0; k < 3; ++k) {
    const float axis = s[3 + k];
    center[k] = s[k];
    if (kind == kSphere) half[k] = s[3];
    if (kind == kCapsule) {
      center[k] += 0.5f * s[6] * axis;
      half[k] = 0.5f * s[6] * std::abs(axis) + s[7];
    }
    if (kind == kCylinder) {
      half[k] = s[6] * std::abs(axis) + s[7] * std::sqrt(std::max(0.0f, 1.0f - axis * axis));
    }
    if (kind == kBox) {
      half[k] = 0.0f;
      for (int j = 0; j < 3; ++j) half[k] += std::abs(s[3 + 3 * k + j]) * s[12 + j];
    }
    half[k] += 1e-6f * (half[k] + std::abs(center[k]));
  }
}

class ShapeWorlds : Casting {
 public:
  ShapeWorlds(const Rows& shapes, const Kinds& kinds, const Indices& first, int threads,
              const std::string& simd)
      : Casting(threads, simd) {
    const size_t count = shapes.shape(0);
    require_rows(count, "shapes and kinds differ in number", kinds);
    require(first.size() > 0 && first.data()[0] == 0 &&
                first.data()[first.size() - 1] == static_cast<int64_t>(count),
            "the first shapes of worlds must begin with 0 and end with the number of shapes");
    for (size_t w = 0; w + 1 < first.size(); ++w) {
      const int64_t begin = first.data()[w], end = first.data()[w + 1];
      require(begin <= end && end <= static_cast<int64_t>(count),
              "the first shapes of worlds must ascend");
      add_world(shapes, kinds, static_cast<size_t>(begin), static_cast<size_t>(end));
    }
  }

  size_t size() const { return worlds_.size(); }

  void depth(const Points& p, const Rotations& R, const Indices& world, const Points& directions,
             float half_pixel, const DepthRows& depth) {
    for_each_camera(p, R, world, size(), directions, half_pixel, depth, max_bodies_,
                    [this](size_t w, auto&&... rest) { kernels_.cast_shapes(view(w), rest...); });
  }

  void nearest(const Points& p, const Indices& world, const DepthRows& values,
               const Output& gradients) {
    const size_t n = p.shape(0), count = values.shape(1);
    require(values.shape(0) == n && gradients.shape(0) == n && gradients.shape(1) == count &&
                gradients.shape(2) == 3,
            "points, values and gradients differ in shape");
    require(count >= 1 && count <= kMaxNearest, "the number of nearest shapes must be in [1, 16]");
    require_worlds(world, n, size());
    const nb::gil_scoped_release release;
    for (size_t i = 0; i < n; ++i) {
      kernels_.nearest_shapes(view(static_cast<size_t>(world.data()[i])), p.data() + 3 * i, count,
                              values.data() + i * count, gradients.data() + 3 * i * count);
    }
  }

 private:
  struct Range {
    size_t body, body_count, half_space, half_space_count, bounds, stride;
  };

  void add_world(const Rows& shapes, const Kinds& kinds, size_t begin, size_t end) {
    Range r{kinds_.size(), 0, half_spaces_.size() / kShapeSize, 0, bounds_.size(), 0};
    for (size_t i = begin; i < end; ++i) {
      const float* s = shapes.data() + i * kShapeSize;
      const uint8_t kind = kinds.data()[i];
      require(kind < kShapeKinds, "unknown kind of shape");
      require(std::all_of(s, s + kShapeSize, [](float x) { return std::isfinite(x); }),
              "the numbers of a shape must be finite");
      std::vector<float>& rows = kind == kHalfSpace ? half_spaces_ : bodies_;
      rows.insert(rows.end(), s, s + kShapeSize);
      if (kind == kHalfSpace) {
        ++r.half_space_count;
      } else {
        kinds_.push_back(kind);
        ++r.body_count;
      }
    }
    r.stride = (r.body_count + kPack - 1) / kPack * kPack;
    bounds_.resize(r.bounds + 6 * r.stride);
    for (size_t i = 0; i < r.body_count; ++i) {
      float center[3], half[3];
      bound(kinds_[r.body + i], bodies_.data() + (r.body + i) * kShapeSize, center, half);
      for (size_t k = 0; k < 3; ++k) {
        bounds_[r.bounds + k * r.stride + i] = center[k];
        bounds_[r.bounds + (k + 3) * r.stride + i] = half[k];
      }
    }
    max_bodies_ = std::max(max_bodies_, r.body_count);
    worlds_.push_back(r);
  }

  ShapeWorld view(size_t w) const {
    const Range& r = worlds_[w];
    return {bodies_.data() + r.body * kShapeSize,
            kinds_.data() + r.body,
            r.body_count,
            bounds_.data() + r.bounds,
            r.stride,
            half_spaces_.data() + r.half_space * kShapeSize,
            r.half_space_count};
  }

  std::vector<float> bodies_, half_spaces_, bounds_;
  std::vector<uint8_t> kinds_;
  std::vector<Range> worlds_;
  size_t max_bodies_ = 0;
};

constexpr size_t kNone = SIZE_MAX;  // no shape
constexpr size_t kBatch = 512;      // of points that share candidates for the nearest shape

class ShapeField {
 public:
  ShapeField(const DoubleRows& shapes, const Kinds& kinds)
      : rows_(shapes.data(), shapes.data() + shapes.size()),
        kinds_(kinds.data(), kinds.data() + kinds.size()) {
    require_rows(shapes.shape(0), "shapes and kinds differ in number", kinds);
    for (const uint8_t kind : kinds_) require(kind < kShapeKinds, "unknown kind of shape");
  }

  void nearest(const QueryPoints& p, const Distances& distances,
               const std::optional<Gradients>& gradients) const {
    const size_t count = p.shape(0);
    require(distances.size() == count && (!gradients || gradients->shape(0) == count),
            "points, distances and gradients differ in number");
    const nb::gil_scoped_release release;
    std::vector<size_t> shapes(kBatch);
    std::vector<double> at_center(kinds_.size());
    for (size_t first = 0; first < count; first += kBatch) {
      const size_t batch = std::min(kBatch, count - first);
      nearest_of_batch(p.data() + 3 * first, batch, distances.data() + first, shapes.data(),
                       at_center);
      if (!gradients) continue;
      for (size_t i = 0; i < batch; ++i) {
        double* gradient = gradients->data() + 3 * (first + i);
        const size_t shape = shapes[i];
        if (shape == kNone) {
          std::fill_n(gradient, 3, 0.0);
        } else {
          distance(shape, p.data() + 3 * (first + i), gradient);
        }
      }
    }
  }

 private:
  double distance(size_t shape, const double* p, double* gradient = nullptr) const {
    const double* row = rows_.data() + shape * kShapeSize;
    return SIMD_LEVEL::shape_distance(kinds_[shape], row, p, gradient);
  }

  // Distances are 1-Lipschitz: within R of a center c the nearest shape is at most min d(c) + R
  // away, so a shape with d(c) > min d(c) + 2 R is never the nearest.
  void nearest_of_batch(const double* p, size_t count, double* distances, size_t* shapes,
                        std::vector<double>& at_center) const {
    double lower[3], upper[3], center[3], span[3];
    for (int k = 0; k < 3; ++k) {
      lower[k] = upper[k] = p[k];
      for (size_t i = 1; i < count; ++i) {
        lower[k] = std::min(lower[k], p[3 * i + k]);
        upper[k] = std::max(upper[k], p[3 * i + k]);
      }
      center[k] = 0.5 * (lower[k] + upper[k]);
      span[k] = upper[k] - lower[k];
    }
    double min_distance = std::numeric_limits<double>::infinity();
    for (size_t shape = 0; shape < kinds_.size(); ++shape) {
      at_center[shape] = distance(shape, center);
      min_distance = std::min(min_distance, at_center[shape]);
    }
    const double limit = min_distance + SIMD_LEVEL::length(span) + 1e-9;
    std::fill_n(distances, count, std::numeric_limits<double>::infinity());
    std::fill_n(shapes, count, kNone);
    for (size_t shape = 0; shape < kinds_.size(); ++shape) {
      if (at_center[shape] > limit) continue;  // keeps all where a point is not finite
      for (size_t i = 0; i < count; ++i) {
        const double d = distance(shape, p + 3 * i);
        if (d < distances[i]) {
          distances[i] = d;
          shapes[i] = shape;
        }
      }
    }
  }

  std::vector<double> rows_;
  std::vector<uint8_t> kinds_;
};

}  // namespace

void bind_shapes(nb::module_& m) {
  nb::class_<ShapeWorlds>(m, "ShapeWorlds", "The analytic shapes of several worlds.")
      .def(nb::init<const Rows&, const Kinds&, const Indices&, int, const std::string&>(),
           nb::kw_only(), "shapes"_a, "kinds"_a, "first"_a, "threads"_a = 1, "simd"_a = "",
           "World w has the rows first[w] to first[w + 1]. A row holds, by its kind: 0 center and\n"
           "radius of a sphere; 1 end, axis, length and radius of a capsule; 2 center, axis, half\n"
           "length and radius of a cylinder; 3 center, rotation and half sizes of a box; 4 normal\n"
           "and offset of a half space.")
      .def("__len__", &ShapeWorlds::size)
      .def("depth", &ShapeWorlds::depth, nb::kw_only(), "p_WC"_a, "R_WC"_a, "world"_a,
           "directions_C"_a, "half_pixel"_a, "depth"_a, "Writes the depth images of N cameras.")
      .def("nearest", &ShapeWorlds::nearest, nb::kw_only(), "p_WQ"_a, "world"_a, "values"_a,
           "gradients"_a,
           "Writes the distances (N, K) of the K nearest shapes and their gradients (N, K, 3).");
  nb::class_<ShapeField>(m, "ShapeField", "The distance field of analytic shapes.")
      .def(nb::init<const DoubleRows&, const Kinds&>(), nb::kw_only(), "shapes"_a, "kinds"_a,
           "Rows and kinds as of `ShapeWorlds`.")
      .def("nearest", &ShapeField::nearest, nb::kw_only(), "p_WQ"_a, "distances"_a,
           "gradients"_a = nb::none(),
           "Writes the signed distances (N,) of N points to the nearest shape and their gradients\n"
           "(N, 3); infinite and zero without shapes.");
}

}  // namespace splatpilot
