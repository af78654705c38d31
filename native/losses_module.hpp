#pragma once

#include <nanobind/nanobind.h>

namespace splatpilot {

// Adds the losses to the module.
void bind_losses(nanobind::module_& m);

}  // namespace splatpilot
