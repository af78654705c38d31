#include <nanobind/nanobind.h>

NB_MODULE(_native, m) { m.doc() = "Splat kernels for CPUs."; }
