// The SIMD levels of this machine.
#pragma once

#include <string>
#include <vector>

#include "core/types.hpp"

namespace splatpilot {

// Names of the levels that this machine can run, widest first.
std::vector<std::string> simd_levels();

// The kernels of a level; the widest if the name is empty. Throws std::invalid_argument for others.
const Kernels& kernels(const std::string& level);

}  // namespace splatpilot
