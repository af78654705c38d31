#include "project/baked_scene.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
#include <numeric>
#include <utility>

#include "core/radix_sort.hpp"

#define SIMD_LEVEL baseline
#include "core/vectors.hpp"

namespace splatpilot {
namespace {

constexpr size_t kPack = 16;

size_t num_groups(size_t count) { return (count + kPack - 1) / kPack; }

// Spreads the low 21 bits of x to every third bit.
uint64_t spread(uint64_t x) {
  x = (x | x << 32) & 0x1f00000000ffff;
  x = (x | x << 16) & 0x1f0000ff0000ff;
  x = (x | x << 8) & 0x100f00f00f00f00f;
  x = (x | x << 4) & 0x10c30c30c30c30c3;
  x = (x | x << 2) & 0x1249249249249249;
  return x;
}

// The bounds of an axis of the centers of Gaussians index(begin), ..., index(end - 1).
template <typename Index>
std::pair<double, double> range(const GaussianArrays& g, size_t axis, size_t begin, size_t end,
                                const Index& index) {
  double low = std::numeric_limits<double>::infinity(), high = -low;
  for (size_t slot = begin; slot < end; ++slot) {
    const double value = g.means[3 * static_cast<size_t>(index(slot)) + axis];
    low = std::min(low, value);
    high = std::max(high, value);
  }
  return {low, high};
}

std::vector<uint32_t> morton_order(const GaussianArrays& g) {
  double low[3], size = 0.0;
  for (size_t axis = 0; axis < 3; ++axis) {
    const auto [min, max] = range(g, axis, 0, g.count, [](size_t slot) { return slot; });
    low[axis] = min;
    size = std::max(size, max - min);
  }
  const double scale = size > 0.0 ? ((1 << 21) - 1) / size : 0.0;
  std::vector<KeyValue<uint64_t>> codes(g.count), scratch;
  for (size_t i = 0; i < g.count; ++i) {
    codes[i].value = static_cast<uint32_t>(i);
    for (size_t axis = 0; axis < 3; ++axis) {
      const double cell = (g.means[3 * i + axis] - low[axis]) * scale;
      codes[i].key |= spread(static_cast<uint64_t>(cell)) << axis;
    }
  }
  radix_sort(codes, scratch);
  std::vector<uint32_t> order(g.count);
  std::transform(codes.begin(), codes.end(), order.begin(),
                 [](const KeyValue<uint64_t>& code) { return code.value; });
  return order;
}

// The rows of A = R(q) diag(scale), orthogonalized: A = L Q, so L L^T = A A^T.
std::array<double, 6> lower_factor(const float* quat, const float* scale) {
  const double q[4] = {quat[0], quat[1], quat[2], quat[3]};
  SIMD_LEVEL::Vector3<double> R[3];
  SIMD_LEVEL::rotation_columns(q, R);
  double a[3][3];
  for (int j = 0; j < 3; ++j) {
    a[0][j] = R[j].x * scale[j];
    a[1][j] = R[j].y * scale[j];
    a[2][j] = R[j].z * scale[j];
  }
  std::array<double, 6> L{};
  size_t entry = 0;
  for (int i = 0; i < 3; ++i) {
    for (int k = 0; k < i; ++k) {  // rows k < i are unit vectors or zero
      double along = 0.0;
      for (int j = 0; j < 3; ++j) along += a[i][j] * a[k][j];
      for (int j = 0; j < 3; ++j) a[i][j] -= along * a[k][j];
      L[entry++] = along;
    }
    const double length = std::sqrt(a[i][0] * a[i][0] + a[i][1] * a[i][1] + a[i][2] * a[i][2]);
    for (int j = 0; j < 3; ++j) a[i][j] = length > 0.0 ? a[i][j] / length : 0.0;
    L[entry++] = length;
  }
  return L;
}

std::vector<float> pack_geometry(const GaussianArrays& g, const std::vector<uint32_t>& order) {
  const size_t groups = num_groups(g.count);
  std::vector<float> geometry(groups * 10 * kPack, 0.0f);
  for (size_t slot = 0; slot < groups * kPack; ++slot) {
    float* pack = geometry.data() + slot / kPack * 10 * kPack + slot % kPack;
    pack[9 * kPack] = -std::numeric_limits<float>::infinity();
    if (slot >= g.count) continue;
    const size_t i = order[slot];
    for (size_t axis = 0; axis < 3; ++axis) pack[axis * kPack] = g.means[3 * i + axis];
    const std::array<double, 6> L = lower_factor(g.quats + 4 * i, g.scales + 3 * i);
    for (size_t k = 0; k < 6; ++k) pack[(3 + k) * kPack] = static_cast<float>(L[k]);
    pack[9 * kPack] = static_cast<float>(std::log2(static_cast<double>(g.opacities[i])));
  }
  return geometry;
}

std::vector<float> box_bounds(const GaussianArrays& g, const std::vector<uint32_t>& order) {
  const size_t boxes = (num_groups(g.count) * kPack + kBoundSize - 1) / kBoundSize;
  const size_t box_groups = num_groups(boxes);
  // A missing box is NaN, which passes no comparison.
  std::vector<float> bounds(box_groups * 7 * kPack, std::numeric_limits<float>::quiet_NaN());
  for (size_t box = 0; box < boxes; ++box) {
    const size_t begin = box * kBoundSize, end = std::min(g.count, begin + kBoundSize);
    float* pack = bounds.data() + box / kPack * 7 * kPack + box % kPack;
    float largest_scale = 0.0f;
    for (size_t slot = begin; slot < end; ++slot) {
      const float* scale = g.scales + 3 * static_cast<size_t>(order[slot]);
      largest_scale = std::max({largest_scale, scale[0], scale[1], scale[2]});
    }
    pack[6 * kPack] = largest_scale;
    for (size_t axis = 0; axis < 3; ++axis) {
      const auto [low, high] = range(g, axis, begin, end, [&](size_t slot) { return order[slot]; });
      const double center = 0.5 * (low + high), half = 0.5 * (high - low);
      pack[axis * kPack] = static_cast<float>(center);
      // Widened so that rounding never leaves a Gaussian outside its box.
      const double slack = 1e-5 * (half + std::fabs(center)) + 1e-30;
      pack[(3 + axis) * kPack] = static_cast<float>(half + slack);
    }
  }
  return bounds;
}

// Gaussian `slot` of packed groups: its center, the lower triangle of its covariance by rows, and
// its opacity.
struct Moments {
  double mean[3], covariance[6], opacity;
};

Moments moments_at(const float* geometry, size_t slot) {
  const float* pack = geometry + slot / kPack * 10 * kPack + slot % kPack;
  const auto field = [&](size_t k) { return static_cast<double>(pack[k * kPack]); };
  const double L[3][3] = {
      {field(3), 0, 0}, {field(4), field(5), 0}, {field(6), field(7), field(8)}};
  Moments m{{field(0), field(1), field(2)}, {}, std::exp2(field(9))};
  for (size_t i = 0, entry = 0; i < 3; ++i) {
    for (size_t j = 0; j <= i; ++j, ++entry) {
      for (size_t k = 0; k < 3; ++k) m.covariance[entry] += L[i][k] * L[j][k];
    }
  }
  return m;
}

// The product of the two larger standard deviations of a flat covariance, in proportion to the area
// that it covers when seen from its broad side.
double area(const double c[6]) {
  const double minors =
      c[0] * c[2] - c[1] * c[1] + c[0] * c[5] - c[3] * c[3] + c[2] * c[5] - c[4] * c[4];
  return std::sqrt(std::max(minors, 0.0));
}

// Writes one Gaussian for those of `slots`; returns the root mean square distance of their centers.
double merge(const float* geometry, const uint32_t* slots, const double* areas, size_t count,
             float* pack) {
  double weight = 1e-300, mean[3] = {}, c[6] = {}, squared = 0.0;
  for (size_t n = 0; n < count; ++n) {
    const Moments m = moments_at(geometry, slots[n]);
    weight += areas[n];
    for (size_t i = 0; i < 3; ++i) mean[i] += areas[n] * m.mean[i];
  }
  for (double& x : mean) x /= weight;
  for (size_t n = 0; n < count; ++n) {
    const Moments m = moments_at(geometry, slots[n]);
    const double share = areas[n] / weight;
    for (size_t i = 0, entry = 0; i < 3; ++i) {
      const double d = m.mean[i] - mean[i];
      squared += share * d * d;
      for (size_t j = 0; j <= i; ++j, ++entry) {
        c[entry] += share * (m.covariance[entry] + d * (m.mean[j] - mean[j]));
      }
    }
  }
  // Together they may cover more than one can: it grows. More growth would blur edges.
  const double cover = weight / std::max(area(c), 1e-300);
  const double grow = std::clamp(cover, 1.0, 1.5);
  for (double& entry : c) entry *= grow;
  const double L00 = std::sqrt(c[0]), L10 = c[1] / std::max(L00, 1e-30);
  const double L11 = std::sqrt(std::max(c[2] - L10 * L10, 0.0)), L20 = c[3] / std::max(L00, 1e-30);
  const double L21 = L11 > 1e-30 ? (c[4] - L20 * L10) / L11 : 0.0;
  const double L22 = std::sqrt(std::max(c[5] - L20 * L20 - L21 * L21, 0.0));
  const double opacity = std::min(cover / grow, 1.0);
  const double fields[10] = {mean[0], mean[1], mean[2], L00, L10,
                             L11,     L20,     L21,     L22, std::log2(std::max(opacity, 1e-30))};
  for (size_t k = 0; k < 10; ++k) pack[k * kPack] = static_cast<float>(fields[k]);
  return std::sqrt(squared);
}

// Sorts slots so that each half, quarter, ... of them lies together.
void halve(const float* geometry, uint32_t* slots, size_t count) {
  if (count < 8) return;  // a level merges four or more
  const auto coordinate = [&](uint32_t slot, size_t axis) {
    return geometry[slot / kPack * 10 * kPack + axis * kPack + slot % kPack];
  };
  size_t widest = 0;
  float widest_size = -1.0f;
  for (size_t axis = 0; axis < 3; ++axis) {
    const auto [low, high] = std::minmax_element(slots, slots + count, [&](uint32_t a, uint32_t b) {
      return coordinate(a, axis) < coordinate(b, axis);
    });
    const float size = coordinate(*high, axis) - coordinate(*low, axis);
    if (size > widest_size) widest = axis, widest_size = size;
  }
  std::sort(slots, slots + count, [&](uint32_t a, uint32_t b) {
    const float x = coordinate(a, widest), y = coordinate(b, widest);
    return x != y ? x < y : a < b;
  });
  halve(geometry, slots, count / 2);
  halve(geometry, slots + count / 2, count - count / 2);
}

}  // namespace

void BakedScene::merge_neighbors() {
  if (merged_) return;
  auto merged = std::make_shared<Merged>();
  const float* geometry = shape_->geometry.data();
  const size_t boxes = count() / kBoundSize;  // without a last one that is not full
  const size_t all = (num_groups(count()) * kPack + kBoundSize - 1) / kBoundSize;
  merged->slots.resize(boxes * kBoundSize);
  merged->areas.resize(boxes * kBoundSize);
  merged->geometry.assign(all * kMergeLevels * 10 * kPack, 0.0f);
  merged->spreads.assign(num_groups(all) * kMergeLevels * kPack,
                         std::numeric_limits<float>::infinity());
  for (size_t box = 0; box < boxes; ++box) {
    uint32_t* slots = merged->slots.data() + box * kBoundSize;
    double* areas = merged->areas.data() + box * kBoundSize;
    std::iota(slots, slots + kBoundSize, static_cast<uint32_t>(box * kBoundSize));
    halve(geometry, slots, kBoundSize);
    for (size_t n = 0; n < kBoundSize; ++n) {
      const Moments m = moments_at(geometry, slots[n]);
      areas[n] = m.opacity * area(m.covariance);
    }
    for (size_t level = 0; level < kMergeLevels; ++level) {
      float* pack = merged->geometry.data() + (box * kMergeLevels + level) * 10 * kPack;
      std::fill_n(pack + 9 * kPack, kPack, -std::numeric_limits<float>::infinity());
      const size_t count = size_t{4} << (2 * level);
      double spread = 0.0;
      for (size_t first = 0; first < kBoundSize; first += count, ++pack) {
        spread = std::max(spread, merge(geometry, slots + first, areas + first, count, pack));
      }
      merged->spreads[(box / kPack * kMergeLevels + level) * kPack + box % kPack] =
          static_cast<float>(spread);
    }
  }
  merged_ = std::move(merged);
  merge_colors();
}

// Colors are means, weighted by the covered areas.
void BakedScene::merge_colors() {
  const size_t values = 3 * static_cast<size_t>((arrays_.sh_degree + 1) * (arrays_.sh_degree + 1));
  const size_t boxes = merged_->slots.size() / kBoundSize;
  const size_t all = merged_->geometry.size() / (kMergeLevels * 10 * kPack);
  merged_colors_.assign(all * kMergeLevels * values * kPack, 0.0f);
  std::vector<double> sums(values);
  for (size_t box = 0; box < boxes; ++box) {
    for (size_t level = 0; level < kMergeLevels; ++level) {
      float* pack = merged_colors_.data() + (box * kMergeLevels + level) * values * kPack;
      const size_t count = size_t{4} << (2 * level);
      for (size_t first = 0; first < kBoundSize; first += count, ++pack) {
        double weight = 1e-300;
        std::fill(sums.begin(), sums.end(), 0.0);
        for (size_t n = box * kBoundSize + first; n < box * kBoundSize + first + count; ++n) {
          const size_t slot = merged_->slots[n];
          const float* from = colors_.data() + slot / kPack * values * kPack + slot % kPack;
          weight += merged_->areas[n];
          for (size_t k = 0; k < values; ++k) sums[k] += merged_->areas[n] * from[k * kPack];
        }
        for (size_t k = 0; k < values; ++k) pack[k * kPack] = static_cast<float>(sums[k] / weight);
      }
    }
  }
  arrays_.merged_geometry = merged_->geometry.data();
  arrays_.merged_colors = merged_colors_.data();
  arrays_.spreads = merged_->spreads.data();
}

BakedScene::BakedScene(const GaussianArrays& g)
    : shape_(std::make_shared<const Shape>(pack_shape(g))) {
  store_colors(g.colors, g.sh_coefficients, g.sh_degree);
}

BakedScene::BakedScene(const BakedScene& other, const float* colors, int sh_coefficients,
                       int sh_degree)
    : shape_(other.shape_), merged_(other.merged_) {
  store_colors(colors, sh_coefficients, sh_degree);
}

BakedScene::Shape BakedScene::pack_shape(const GaussianArrays& g) {
  std::vector<uint32_t> order = morton_order(g);
  std::vector<float> geometry = pack_geometry(g, order), bounds = box_bounds(g, order);
  return {std::move(order), std::move(geometry), std::move(bounds)};
}

void BakedScene::store_colors(const float* colors, int sh_coefficients, int sh_degree) {
  const size_t values = 3 * static_cast<size_t>((sh_degree + 1) * (sh_degree + 1));
  const size_t groups = num_groups(count());
  colors_.assign(groups * values * kPack, 0.0f);
  for (size_t slot = 0; slot < count(); ++slot) {
    float* pack = colors_.data() + slot / kPack * values * kPack + slot % kPack;
    const float* row = colors + 3 * static_cast<size_t>(sh_coefficients) * shape_->order[slot];
    for (size_t k = 0; k < values; ++k) {
      pack[k * kPack] =
          sh_degree == 0 ? std::max(0.0f, 0.5f + 0.28209479177387814f * row[k]) : row[k];
    }
  }
  arrays_ = {groups,
             shape_->geometry.data(),
             colors_.data(),
             sh_degree,
             shape_->bounds.data(),
             nullptr,
             nullptr,
             nullptr};
  if (merged_) merge_colors();
}

}  // namespace splatpilot
