#include "baked_scene.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
#include <numeric>

namespace splatpilot {
namespace {

constexpr size_t kPack = 16;

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
  std::vector<uint64_t> codes(g.count);
  for (size_t i = 0; i < g.count; ++i) {
    for (size_t axis = 0; axis < 3; ++axis) {
      const double cell = (static_cast<double>(g.means[3 * i + axis]) - low[axis]) * scale;
      codes[i] |= spread(static_cast<uint64_t>(cell)) << axis;
    }
  }
  std::vector<uint32_t> order(g.count);
  std::iota(order.begin(), order.end(), 0u);
  std::stable_sort(order.begin(), order.end(),
                   [&](uint32_t a, uint32_t b) { return codes[a] < codes[b]; });
  return order;
}

// The rows of A = R(q) diag(scale), orthogonalised: A = L Q, so L L^T = A A^T.
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

}  // namespace

BakedScene::BakedScene(const GaussianArrays& g) {
  const std::vector<uint32_t> order = morton_order(g);
  arrays_.groups = (g.count + kPack - 1) / kPack;
  arrays_.sh_degree = g.sh_degree;
  store_geometry(g, order);
  store_colors(g, order);
  store_bounds(g, order);
  arrays_.geometry = geometry_.data();
  arrays_.colors = colors_.data();
  arrays_.bounds = bounds_.data();
}

void BakedScene::store_geometry(const GaussianArrays& g, const std::vector<uint32_t>& order) {
  geometry_.assign(arrays_.groups * 10 * kPack, 0.0f);
  for (size_t slot = 0; slot < arrays_.groups * kPack; ++slot) {
    float* pack = geometry_.data() + slot / kPack * 10 * kPack + slot % kPack;
    pack[9 * kPack] = -std::numeric_limits<float>::infinity();
    if (slot >= g.count) continue;
    const size_t i = order[slot];
    for (size_t axis = 0; axis < 3; ++axis) pack[axis * kPack] = g.means[3 * i + axis];
    const std::array<double, 6> L = lower_factor(g.quats + 4 * i, g.scales + 3 * i);
    for (size_t k = 0; k < 6; ++k) pack[(3 + k) * kPack] = static_cast<float>(L[k]);
    pack[9 * kPack] = static_cast<float>(std::log2(static_cast<double>(g.opacities[i])));
  }
}

void BakedScene::store_colors(const GaussianArrays& g, const std::vector<uint32_t>& order) {
  const size_t values = 3 * static_cast<size_t>((g.sh_degree + 1) * (g.sh_degree + 1));
  colors_.assign(arrays_.groups * values * kPack, 0.0f);
  for (size_t slot = 0; slot < g.count; ++slot) {
    float* pack = colors_.data() + slot / kPack * values * kPack + slot % kPack;
    const float* row = g.colors + 3 * static_cast<size_t>(g.sh_coefficients) * order[slot];
    for (size_t k = 0; k < values; ++k) {
      pack[k * kPack] =
          g.sh_degree == 0 ? std::max(0.0f, 0.5f + 0.28209479177387814f * row[k]) : row[k];
    }
  }
}

void BakedScene::store_bounds(const GaussianArrays& g, const std::vector<uint32_t>& order) {
  const size_t boxes = (arrays_.groups * kPack + kBoundSize - 1) / kBoundSize;
  const size_t box_groups = (boxes + kPack - 1) / kPack;
  // A box that does not exist is NaN, which passes no comparison.
  bounds_.assign(box_groups * 7 * kPack, std::numeric_limits<float>::quiet_NaN());
  for (size_t box = 0; box < boxes; ++box) {
    const size_t begin = box * kBoundSize, end = std::min(g.count, begin + kBoundSize);
    float* pack = bounds_.data() + box / kPack * 7 * kPack + box % kPack;
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
      const double centre = 0.5 * (low + high), half = 0.5 * (high - low);
      pack[axis * kPack] = static_cast<float>(centre);
      // Widened so that rounding never leaves a Gaussian outside its box.
      const double slack = 1e-5 * (half + std::fabs(centre)) + 1e-30;
      pack[(3 + axis) * kPack] = static_cast<float>(half + slack);
    }
  }
}

}  // namespace splatpilot
