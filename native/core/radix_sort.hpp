// Stable sort of items by an unsigned key.
#pragma once

#include <algorithm>
#include <array>
#include <cstdint>
#include <limits>
#include <vector>

namespace splatpilot {

template <typename Key>
struct KeyValue {
  Key key;
  uint32_t value;
};

// Sorts `items` by key, stably; `scratch` is resized as needed.
template <typename Key>
void radix_sort(std::vector<KeyValue<Key>>& items, std::vector<KeyValue<Key>>& scratch) {
  if (items.empty()) return;
  scratch.resize(items.size());

  // Only the bits in which keys differ from the smallest need sorting.
  Key low = items[0].key, high = items[0].key;
  for (const KeyValue<Key>& item : items) {
    low = std::min(low, item.key);
    high = std::max(high, item.key);
  }
  constexpr int kDigitBits = 11;
  constexpr Key kDigits = Key{1} << kDigitBits;
  for (int shift = 0; shift < std::numeric_limits<Key>::digits && ((high - low) >> shift) != 0;
       shift += kDigitBits) {
    std::array<uint32_t, kDigits> start{};
    const auto digit = [&](const KeyValue<Key>& item) {
      return ((item.key - low) >> shift) & (kDigits - 1);
    };
    for (const KeyValue<Key>& item : items) ++start[digit(item)];
    uint32_t sum = 0;
    for (uint32_t& s : start) {
      const uint32_t count = s;
      s = sum;
      sum += count;
    }
    for (const KeyValue<Key>& item : items) scratch[start[digit(item)]++] = item;
    items.swap(scratch);
  }
}

}  // namespace splatpilot
