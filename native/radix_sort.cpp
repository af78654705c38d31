#include "radix_sort.hpp"

#include <algorithm>
#include <array>

namespace splatpilot {

void radix_sort(std::vector<KeyValue>& items, std::vector<KeyValue>& scratch) {
  if (items.empty()) return;
  scratch.resize(items.size());

  // Only the bits in which keys differ from the smallest need sorting.
  uint32_t low = items[0].key, high = items[0].key;
  for (const KeyValue& item : items) {
    low = std::min(low, item.key);
    high = std::max(high, item.key);
  }
  constexpr int kDigitBits = 11;
  constexpr uint32_t kDigits = 1u << kDigitBits;
  for (int shift = 0; shift < 32 && ((high - low) >> shift) != 0; shift += kDigitBits) {
    std::array<uint32_t, kDigits> start{};
    const auto digit = [&](const KeyValue& i) { return ((i.key - low) >> shift) & (kDigits - 1); };
    for (const KeyValue& item : items) ++start[digit(item)];
    uint32_t sum = 0;
    for (uint32_t& s : start) {
      const uint32_t count = s;
      s = sum;
      sum += count;
    }
    for (const KeyValue& item : items) scratch[start[digit(item)]++] = item;
    items.swap(scratch);
  }
}

}  // namespace splatpilot
