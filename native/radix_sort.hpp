// Stable sort of (key, value) pairs by key.
#pragma once

#include <cstdint>
#include <vector>

namespace splatpilot {

struct KeyValue {
  uint32_t key, value;
};

// Sorts `items` by key, keeping the order of equal keys; `scratch` is resized as needed.
void radix_sort(std::vector<KeyValue>& items, std::vector<KeyValue>& scratch);

}  // namespace splatpilot
