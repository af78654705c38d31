#include "project/baked_scene.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
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

}  // namespace

BakedScene::BakedScene(const GaussianArrays& g)
    : shape_(std::make_shared<const Shape>(pack_shape(g))) {
  store_colors(g.colors, g.sh_coefficients, g.sh_degree);
}

BakedScene::BakedScene(const BakedScene& other, const float* colors, int sh_coefficients,
                       int sh_degree)
    : shape_(other.shape_) {
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
  arrays_ = {groups, shape_->geometry.data(), colors_.data(), sh_degree, shape_->bounds.data()};
}

}  // namespace splatpilot
