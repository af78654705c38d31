// How many (Gaussian, tile) pairs a frame may have.
#pragma once

#include <cstdint>
#include <stdexcept>
#include <string>

namespace splatpilot {

// The places of pairs are kept in 32 bits.
constexpr uint64_t kMaxPairs = UINT32_MAX;

// Throws std::length_error for more than a frame may have.
inline void check_pair_count(uint64_t pairs) {
  if (pairs <= kMaxPairs) return;
  throw std::length_error("the image has " + std::to_string(pairs) +
                          " pairs of a Gaussian and a 16x16-pixel tile that it touches; at most " +
                          std::to_string(kMaxPairs) +
                          " are possible: render a smaller image, or fewer or smaller Gaussians");
}

}  // namespace splatpilot
