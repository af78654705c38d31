// Python binding of the distance field of analytic shapes, in double precision; rows of shapes are
// those of `splatpilot.systems.collision.shapes`.
#include <nanobind/stl/optional.h>

#include <cstdint>
#include <limits>
#include <optional>
#include <vector>

#include "bindings/bindings.hpp"
#include "casting/ray_casting.hpp"

namespace splatpilot {
namespace {

using namespace nb::literals;
using Gradients = nb::ndarray<double, nb::shape<-1, 3>, nb::c_contig, nb::device::cpu>;
using ShapeRows = Doubles<nb::shape<-1, kShapeSize>>;
using ShapeKinds = nb::ndarray<const uint8_t, nb::ndim<1>, nb::c_contig, nb::device::cpu>;
using QueryPoints = Doubles<nb::shape<-1, 3>>;
using Distances = nb::ndarray<double, nb::ndim<1>, nb::c_contig, nb::device::cpu>;

constexpr size_t kNone = SIZE_MAX;  // in place of a shape
constexpr size_t kBatch = 512;      // of points, which share their candidates for the nearest shape

// Generated worlds of given seeds depend on this order of additions.
double dot(const double* a, const double* b) { return (a[0] * b[0] + a[2] * b[2]) + a[1] * b[1]; }

double norm(const double* a) { return std::sqrt(dot(a, a)); }

// Writes a at unit length; zero becomes perpendicular to the unit vector `axis`.
void write_unit(const double* a, const double* axis, double* unit) {
  double size = norm(a);
  std::copy_n(a, 3, unit);
  if (size == 0.0) {
    int least = 0;
    for (int k = 1; k < 3; ++k) {
      if (std::abs(axis[k]) < std::abs(axis[least])) least = k;
    }
    const int next = (least + 1) % 3, last = (least + 2) % 3;
    unit[next] = axis[last];
    unit[last] = -axis[next];
    size = norm(unit);
  }
  for (int k = 0; k < 3; ++k) unit[k] /= size;
}

// Distances of p to a shape s, and their gradients, which may be null.

double sphere_distance(const double* p, const double* s, double* gradient) {
  const double away[3] = {p[0] - s[0], p[1] - s[1], p[2] - s[2]}, up[3] = {0.0, 0.0, 1.0};
  if (gradient) write_unit(away, up, gradient);
  return norm(away) - s[3];
}

double capsule_distance(const double* p, const double* s, double* gradient) {
  double away[3] = {p[0] - s[0], p[1] - s[1], p[2] - s[2]};
  const double along = std::min(std::max(dot(away, s + 3), 0.0), s[6]);
  for (int k = 0; k < 3; ++k) away[k] -= along * s[3 + k];
  if (gradient) write_unit(away, s + 3, gradient);
  return norm(away) - s[7];
}

double cylinder_distance(const double* p, const double* s, double* gradient) {
  const double* axis = s + 3;
  double radial[3] = {p[0] - s[0], p[1] - s[1], p[2] - s[2]};
  const double along = dot(radial, axis);
  for (int k = 0; k < 3; ++k) radial[k] -= along * axis[k];
  const double end = std::abs(along) - s[6], side = norm(radial) - s[7];
  const double inner = std::max(end, side);
  const double outside = std::hypot(std::max(end, 0.0), std::max(side, 0.0));
  if (gradient) {
    const double by_end = inner > 0.0 ? std::max(end, 0.0) / outside : end >= side;
    const double by_side = inner > 0.0 ? std::max(side, 0.0) / outside : end < side;
    write_unit(radial, axis, gradient);
    for (int k = 0; k < 3; ++k) {
      gradient[k] = std::copysign(by_end, along) * axis[k] + by_side * gradient[k];
    }
  }
  return outside + std::min(inner, 0.0);
}

double box_distance(const double* p, const double* s, double* gradient) {
  const double *R = s + 3, *half = s + 12;
  const double d[3] = {p[0] - s[0], p[1] - s[1], p[2] - s[2]};
  double square = 0.0, local[3], beyond[3];
  int deepest = 0;
  for (int k = 0; k < 3; ++k) {
    local[k] = d[0] * R[k] + d[1] * R[3 + k] + d[2] * R[6 + k];
    beyond[k] = std::abs(local[k]) - half[k];
    const double outside = std::max(beyond[k], 0.0);
    square += outside * outside;
    if (beyond[k] > beyond[deepest]) deepest = k;
  }
  const double outside = std::sqrt(square), distance = outside + std::min(beyond[deepest], 0.0);
  if (gradient) {
    for (int k = 0; k < 3; ++k) {
      beyond[k] = outside > 0.0 ? std::max(beyond[k], 0.0) / outside : k == deepest;
      beyond[k] = std::copysign(beyond[k], local[k]);
    }
    for (int k = 0; k < 3; ++k) gradient[k] = dot(R + 3 * k, beyond);
  }
  return distance;
}

double half_space_distance(const double* p, const double* s, double* gradient) {
  if (gradient) std::copy_n(s, 3, gradient);
  return dot(p, s) - s[3];
}

using Distance = double (*)(const double*, const double*, double*);
constexpr Distance kDistances[kShapeKinds] = {sphere_distance, capsule_distance, cylinder_distance,
                                              box_distance, half_space_distance};

class ShapeField {
 public:
  ShapeField(const ShapeRows& shapes, const ShapeKinds& kinds)
      : rows_(shapes.data(), shapes.data() + shapes.size()),
        kinds_(kinds.data(), kinds.data() + kinds.size()) {
    require(kinds.size() == shapes.shape(0), "the kinds of shapes differ in number from them");
    for (const uint8_t kind : kinds_) require(kind < kShapeKinds, "a shape is of no known kind");
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
          kDistances[kinds_[shape]](p.data() + 3 * (first + i), row(shape), gradient);
        }
      }
    }
  }

 private:
  const double* row(size_t shape) const { return rows_.data() + shape * kShapeSize; }

  // Distances are 1-Lipschitz: within R of a centre c the nearest shape is at most min d(c) + R
  // away, so a shape with d(c) > min d(c) + 2 R is nowhere the nearest.
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
    double least = std::numeric_limits<double>::infinity();
    for (size_t shape = 0; shape < kinds_.size(); ++shape) {
      at_center[shape] = kDistances[kinds_[shape]](center, row(shape), nullptr);
      least = std::min(least, at_center[shape]);
    }
    const double limit = least + norm(span) + 1e-9;
    std::fill_n(distances, count, std::numeric_limits<double>::infinity());
    std::fill_n(shapes, count, kNone);
    for (size_t shape = 0; shape < kinds_.size(); ++shape) {
      if (at_center[shape] > limit) continue;  // keeps all where a point is not finite
      const Distance distance = kDistances[kinds_[shape]];
      for (size_t i = 0; i < count; ++i) {
        const double d = distance(p + 3 * i, row(shape), nullptr);
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

void bind_shape_field(nb::module_& m) {
  nb::class_<ShapeField>(m, "ShapeField", "The distance field of analytic shapes.")
      .def(nb::init<const ShapeRows&, const ShapeKinds&>(), nb::kw_only(), "shapes"_a, "kinds"_a,
           "Rows and kinds as of `ShapeWorlds`.")
      .def("nearest", &ShapeField::nearest, nb::kw_only(), "p_WQ"_a, "distances"_a,
           "gradients"_a = nb::none(),
           "Writes the signed distances (N,) of N points to the nearest shape and their gradients\n"
           "(N, 3); infinite and zero where there is no shape.");
}

}  // namespace splatpilot
