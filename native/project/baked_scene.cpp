#include "project/baked_scene.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <limits>

#include "core/radix_sort.hpp"

namespace splatpilot {
namespace {

constexpr size_t kPack = 16;

size_t groups_of(size_t count) { return (count + kPack - 1) / kPack; }

// Spreads the low 21 bits of x to every third bit.
uint64_t spread(uint64_t x) {
  x = (x | x << 32) & 0x1f00000000ffff;
  x = (x | x << 16) & 0x1f0000ff0000ff;
  x = (x | x << 8) & 0x100f00f00f00f00f;
  x = (x | x << 4) & 0x10c30c30c30c30c3;
  x = (x | x << 2) & 0x1249249249249249;
  return x;
}

std::vector<uint32_t> morton_order(const GaussianArrays& g) {
  std::array<float, 3> low, high;
  low.fill(std::numeric_limits<float>::infinity());
  high.fill(-std::numeric_limits<float>::infinity());
  for (size_t i = 0; i < g.count; ++i) {
    for (size_t axis = 0; axis < 3; ++axis) {
      low[axis] = std::min(low[axis], g.means[3 * i + axis]);
      high[axis] = std::max(high[axis], g.means[3 * i + axis]);
    }
  }
  double size = 0.0;
  for (size_t axis = 0; axis < 3; ++axis) {
    size = std::max(size, static_cast<double>(high[axis]) - low[axis]);
  }
  const double scale = size > 0.0 ? ((1 << 21) - 1) / size : 0.0;
  std::vector<KeyValue<uint64_t>> codes(g.count), scratch;
  for (size_t i = 0; i < g.count; ++i) {
    codes[i].value = static_cast<uint32_t>(i);
    for (size_t axis = 0; axis < 3; ++axis) {
      const double cell = (static_cast<double>(g.means[3 * i + axis]) - low[axis]) * scale;
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
  const double w = quat[0], x = quat[1], y = quat[2], z = quat[3];
  const double two = 2.0 / (w * w + x * x + y * y + z * z);
  double a[3][3] = {{1 - two * (y * y + z * z), two * (x * y - w * z), two * (x * z + w * y)},
                    {two * (x * y + w * z), 1 - two * (x * x + z * z), two * (y * z - w * x)},
                    {two * (x * z - w * y), two * (y * z + w * x), 1 - two * (x * x + y * y)}};
  for (auto& row : a) {
    for (int j = 0; j < 3; ++j) row[j] *= scale[j];
  }
  std::array<double, 6> L{};
  size_t entry = 0;
  for (int i = 0; i < 3; ++i) {
    for (int k = 0; k < i; ++k) {  // rows k < i hold unit vectors by now, or zero
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

std::vector<float> geometry_of(const GaussianArrays& g, const std::vector<uint32_t>& order) {
  const size_t groups = groups_of(g.count);
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

std::vector<float> bounds_of(const GaussianArrays& g, const std::vector<uint32_t>& order) {
  const size_t boxes = (groups_of(g.count) * kPack + kBoundSize - 1) / kBoundSize;
  const size_t box_groups = groups_of(boxes);
  // A box that does not exist is NaN, which passes no comparison.
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
      double low = std::numeric_limits<double>::infinity(), high = -low;
      for (size_t slot = begin; slot < end; ++slot) {
        const double value = g.means[3 * static_cast<size_t>(order[slot]) + axis];
        low = std::min(low, value);
        high = std::max(high, value);
      }
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
    : shape_(std::make_shared<const Shape>(shape_of(g))) {
  store_colors(g.colors, g.sh_coefficients, g.sh_degree);
}

BakedScene::BakedScene(const BakedScene& other, const float* colors, int sh_coefficients,
                       int sh_degree)
    : shape_(other.shape_) {
  store_colors(colors, sh_coefficients, sh_degree);
}

BakedScene::Shape BakedScene::shape_of(const GaussianArrays& g) {
  std::vector<uint32_t> order = morton_order(g);
  std::vector<float> geometry = geometry_of(g, order), bounds = bounds_of(g, order);
  return {std::move(order), std::move(geometry), std::move(bounds)};
}

void BakedScene::store_colors(const float* colors, int sh_coefficients, int sh_degree) {
  const size_t values = 3 * static_cast<size_t>((sh_degree + 1) * (sh_degree + 1));
  const size_t groups = groups_of(count());
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
