// The limit on (Gaussian, tile) pairs of a frame.
#pragma once

#include <cstdint>
#include <stdexcept>
#include <string>

namespace splatpilot {

// Indices of pairs have 32 bits.
constexpr uint64_t kMaxPairs = UINT32_MAX;

inline void check_pair_count(uint64_t pairs) {
  if (pairs <= kMaxPairs) return;
  throw std::length_error("the image has " + std::to_string(pairs) +
                          " pairs of a Gaussian and a 16x16-pixel tile that it touches; at most " +
                          std::to_string(kMaxPairs) +
                          " are possible: render a smaller image, or fewer or smaller Gaussians");
}

}  // namespace splatpilot
