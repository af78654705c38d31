// Python binding of the distance field of analytic shapes, in double precision: operation by
// operation what `splatpilot.systems.collision.shapes` computes, so that worlds have the same bits
// whichever of the two measured them.
#include <limits>
#include <vector>

#include "bindings/bindings.hpp"
#include "casting/ray_casting.hpp"

namespace splatpilot {
namespace {

using namespace nb::literals;
using ShapeRows = Doubles<nb::shape<-1, kShapeSize>>;
using ShapeKinds = nb::ndarray<const uint8_t, nb::ndim<1>, nb::c_contig, nb::device::cpu>;
using QueryPoints = Doubles<nb::shape<-1, 3>>;
using Distances = nb::ndarray<double, nb::ndim<1>, nb::c_contig, nb::device::cpu>;
using Indices = nb::ndarray<int64_t, nb::ndim<1>, nb::c_contig, nb::device::cpu>;

constexpr size_t kBatch = 512;  // of points, which share their candidates for the nearest shape

// In the order in which numpy's einsum adds on processors with AVX2.
double dot(const double* a, const double* b) { return (a[0] * b[0] + a[2] * b[2]) + a[1] * b[1]; }

double norm(const double* a) { return std::sqrt(dot(a, a)); }

double sphere_distance(const double* p, const double* s) {
  const double away[3] = {p[0] - s[0], p[1] - s[1], p[2] - s[2]};
  return norm(away) - s[3];
}

double capsule_distance(const double* p, const double* s) {
  double away[3] = {p[0] - s[0], p[1] - s[1], p[2] - s[2]};
  const double along = std::min(std::max(dot(away, s + 3), 0.0), s[6]);
  for (int k = 0; k < 3; ++k) away[k] -= along * s[3 + k];
  return norm(away) - s[7];
}

double cylinder_distance(const double* p, const double* s) {
  double radial[3] = {p[0] - s[0], p[1] - s[1], p[2] - s[2]};
  const double along = dot(radial, s + 3);
  for (int k = 0; k < 3; ++k) radial[k] -= along * s[3 + k];
  const double end = std::abs(along) - s[6], side = norm(radial) - s[7];
  const double outside = std::hypot(std::max(end, 0.0), std::max(side, 0.0));
  return outside + std::min(std::max(end, side), 0.0);
}

double box_distance(const double* p, const double* s) {
  const double *R = s + 3, *half = s + 12;
  const double d[3] = {p[0] - s[0], p[1] - s[1], p[2] - s[2]};
  double square = 0.0, deepest = -std::numeric_limits<double>::infinity();
  for (int k = 0; k < 3; ++k) {
    const double beyond = std::abs(d[0] * R[k] + d[1] * R[3 + k] + d[2] * R[6 + k]) - half[k];
    const double outside = std::max(beyond, 0.0);
    square += outside * outside;
    deepest = std::max(deepest, beyond);
  }
  return std::sqrt(square) + std::min(deepest, 0.0);
}

double half_space_distance(const double* p, const double* s) { return dot(p, s) - s[3]; }

using Distance = double (*)(const double*, const double*);
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

  void nearest(const QueryPoints& p, const Distances& distances, const Indices& shapes) const {
    const size_t count = p.shape(0);
    require(distances.size() == count && shapes.size() == count,
            "points, distances and shapes differ in number");
    const nb::gil_scoped_release release;
    std::vector<double> at_center(kinds_.size());
    for (size_t first = 0; first < count; first += kBatch) {
      nearest_of_batch(p.data() + 3 * first, std::min(kBatch, count - first),
                       distances.data() + first, shapes.data() + first, at_center);
    }
  }

 private:
  const double* row(size_t shape) const { return rows_.data() + shape * kShapeSize; }

  // Distances are 1-Lipschitz: within R of a centre c the nearest shape is at most min d(c) + R
  // away, so a shape with d(c) > min d(c) + 2 R is nowhere the nearest.
  void nearest_of_batch(const double* p, size_t count, double* distances, int64_t* shapes,
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
      at_center[shape] = kDistances[kinds_[shape]](center, row(shape));
      least = std::min(least, at_center[shape]);
    }
    const double limit = least + norm(span) + 1e-9;
    std::fill_n(distances, count, std::numeric_limits<double>::infinity());
    std::fill_n(shapes, count, int64_t{-1});
    for (size_t shape = 0; shape < kinds_.size(); ++shape) {
      if (at_center[shape] > limit) continue;  // keeps all where a point is not finite
      const Distance distance = kDistances[kinds_[shape]];
      for (size_t i = 0; i < count; ++i) {
        const double d = distance(p + 3 * i, row(shape));
        if (d < distances[i]) {
          distances[i] = d;
          shapes[i] = static_cast<int64_t>(shape);
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
      .def("nearest", &ShapeField::nearest, nb::kw_only(), "p_WQ"_a, "distances"_a, "shapes"_a,
           "Writes the least signed distances (N,) of N points, infinite where there is no shape,\n"
           "and the shapes that have them, the first of several, -1 where there is none.");
}

}  // namespace splatpilot
