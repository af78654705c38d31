#pragma once

#include <nanobind/nanobind.h>

namespace flysplat {

// Adds the losses to the module.
void bind_losses(nanobind::module_& m);

}  // namespace flysplat
