// Fast marching of second order over a regular grid (J. A. Sethian, PNAS 1996).
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <functional>
#include <limits>
#include <queue>
#include <utility>
#include <vector>

namespace splatpilot {

// Times (nx, ny, nz) at which a front from the zeros of `front` [m] arrives, at `speed` [m/s],
// around the cells that are `blocked`; infinite where it does not arrive. Stencils and rounding
// are those of scikit-fmm, with which the benchmark's planner has flown.
class FastMarching {
 public:
  FastMarching(const int64_t* shape, double voxel_size, const double* front, const double* speed,
               const bool* blocked, double* times)
      : strides_{shape[1] * shape[2], shape[2], 1},
        front_(front),
        speed_(speed),
        times_(times),
        states_(static_cast<size_t>(shape[0] * strides_[0]), kFar),
        voxel_size_(voxel_size) {
    std::copy_n(shape, 3, shape_);
    for (size_t i = 0; i < states_.size(); ++i) {
      if (blocked[i]) states_[i] = kBlocked;
    }
    std::fill_n(times, states_.size(), kNever);
  }

  void march() {
    const auto count = static_cast<int64_t>(states_.size());
    for (int64_t i = 0; i < count; ++i) start(i);
    for (int64_t i = 0; i < count; ++i) {
      if (states_[i] == kFar && has_arrived_neighbor(i)) update(i);
    }
    std::vector<int64_t> arrived;
    while (!queue_.empty()) {
      const double time = queue_.top().first;
      arrived.clear();
      for (; !queue_.empty() && queue_.top().first == time; queue_.pop()) {
        const int64_t i = queue_.top().second;
        if (states_[i] != kNarrow || times_[i] != time) continue;  // an earlier estimate
        states_[i] = kArrived;
        arrived.push_back(i);
      }
      for (const int64_t i : arrived) update_neighbors(i);
    }
  }

 private:
  enum State : uint8_t { kFar, kNarrow, kArrived, kBlocked };
  using Estimate = std::pair<double, int64_t>;
  static constexpr double kNever = std::numeric_limits<double>::infinity();

  // The cell `steps` along an axis, -1 if it is outside or blocked.
  int64_t neighbor(int64_t i, int axis, int64_t steps) const {
    const int64_t along = i / strides_[axis] % shape_[axis] + steps;
    if (along < 0 || along >= shape_[axis]) return -1;
    const int64_t n = i + steps * strides_[axis];
    return states_[n] == kBlocked ? -1 : n;
  }

  bool has_arrived(int64_t i) const { return i >= 0 && states_[i] == kArrived; }

  bool has_arrived_neighbor(int64_t i) const {
    for (int axis = 0; axis < 3; ++axis) {
      if (has_arrived(neighbor(i, axis, -1)) || has_arrived(neighbor(i, axis, 1))) return true;
    }
    return false;
  }

  // Cells next to the zeros of the front, on both of its sides.
  void start(int64_t i) {
    if (states_[i] == kBlocked) return;
    double sum = 0.0;
    for (int axis = 0; axis < 3; ++axis) {
      double nearest = 0.0;
      for (int64_t side = -1; side <= 1; side += 2) {
        const int64_t n = neighbor(i, axis, side);
        if (n < 0 || front_[i] * front_[n] >= 0.0) continue;
        const double distance = voxel_size_ * front_[i] / (front_[i] - front_[n]);
        if (nearest == 0.0 || nearest > distance) nearest = distance;
      }
      if (nearest > 0.0) sum += 1.0 / nearest / nearest;
    }
    if (front_[i] != 0.0 && sum == 0.0) return;
    times_[i] = front_[i] == 0.0 ? 0.0 : std::sqrt(1.0 / sum) / speed_[i];
    states_[i] = kArrived;
  }

  void update_neighbors(int64_t i) {
    for (int axis = 0; axis < 3; ++axis) {
      for (int64_t side = -1; side <= 1; side += 2) {
        const int64_t n = neighbor(i, axis, side);
        if (n < 0) continue;
        if (states_[n] != kArrived) {
          update(n);
        } else if (const int64_t next = neighbor(i, axis, 2 * side);
                   next >= 0 && states_[next] == kNarrow) {
          update(next);
        }
      }
    }
  }

  void update(int64_t i) {
    count_ = 0;
    for (int axis = 0; axis < 3; ++axis) add_axis(i, axis);
    times_[i] = solve((1u << count_) - 1u, 1.0 / (speed_[i] * speed_[i]));
    states_[i] = kNarrow;
    queue_.emplace(times_[i], i);
  }

  // Adds the term weight (T - value)^2 of |grad T|^2, of first or second order.
  void add_axis(int64_t i, int axis) {
    double first = kNever, second = kNever;
    for (int64_t side = -1; side <= 1; side += 2) {
      const int64_t n = neighbor(i, axis, side);
      if (!has_arrived(n) || !(times_[n] < first)) continue;
      first = times_[n];
      const int64_t next = neighbor(i, axis, 2 * side);
      if (!has_arrived(next) || times_[next] > first) continue;
      const bool crosses = front_[next] * front_[n] < 0.0 || front_[next] * front_[i] < 0.0;
      second = crosses ? -times_[next] : times_[next];
    }
    if (first == kNever) return;
    const double weight = 1.0 / voxel_size_ / voxel_size_;
    weights_[count_] = second < kNever ? weight * (9.0 / 4.0) : weight;
    values_[count_++] = second < kNever ? (1.0 / 3.0) * (4.0 * first - second) : first;
  }

  // The later root of the sum of the terms in `mask`; without a root, the earliest with fewer.
  double solve(unsigned mask, double squared_slowness) const {
    double a = 0.0, b = 0.0, c = 0.0;
    for (int k = 0; k < count_; ++k) {
      if (!(mask >> k & 1u)) continue;
      a += weights_[k];
      b -= 2.0 * weights_[k] * values_[k];
      c += weights_[k] * (values_[k] * values_[k]);
    }
    c -= squared_slowness;
    const double discriminant = b * b - 4.0 * a * c;
    if (discriminant >= 0.0) return (-b + std::sqrt(discriminant)) / 2.0 / a;
    double earliest = kNever;
    for (int k = 0; k < count_; ++k) {
      const unsigned fewer = mask & ~(1u << k);
      if (fewer != mask && fewer != 0)
        earliest = std::min(earliest, solve(fewer, squared_slowness));
    }
    return earliest;
  }

  int64_t shape_[3], strides_[3];
  const double *front_, *speed_;
  double* times_;
  std::vector<State> states_;
  double voxel_size_;
  std::priority_queue<Estimate, std::vector<Estimate>, std::greater<>> queue_;
  int count_ = 0;  // of terms, by axis
  double weights_[3], values_[3];
};

}  // namespace splatpilot
