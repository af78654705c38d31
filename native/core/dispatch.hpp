// Which SIMD level runs on this machine.
#pragma once

#include <string>
#include <vector>

#include "core/types.hpp"

namespace splatpilot {

// Names of the levels that this machine can run, widest first.
std::vector<std::string> simd_levels();

// The kernels of a level; the widest when the name is empty. Throws std::invalid_argument for a
// level that is unknown or that this machine cannot run.
const Kernels& kernels(const std::string& level);

}  // namespace splatpilot
