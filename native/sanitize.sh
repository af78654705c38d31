#!/bin/sh
# Builds the native module with AddressSanitizer and UndefinedBehaviorSanitizer and runs the tests
# of its kernels against it, each kernel at each SIMD level, beside the installed one; a process per
# test file, as many at a time as there are cores:
#
#     native/sanitize.sh [python] [test files]
set -eu
root=$(cd "$(dirname "$0")/.." && pwd)
python=${1:-$root/.venv/bin/python}
[ $# -gt 0 ] && shift
python=$(cd "$(dirname "$python")" && pwd)/$(basename "$python")
build=$root/build/sanitize
"$python" -m cmake -S "$root" -B "$build" -G Ninja -DCMAKE_BUILD_TYPE=Debug -DCMAKE_CXX_FLAGS_DEBUG= \
  -DCMAKE_MAKE_PROGRAM="$(dirname "$python")/ninja" -DPython_EXECUTABLE="$python" \
  -Dnanobind_DIR="$("$python" -m nanobind --cmake_dir)" \
  -DCMAKE_CXX_FLAGS="-O1 -g1 -fsanitize=address,undefined -fno-sanitize-recover=all"
"$python" -m cmake --build "$build"

# The tests that run native code.
[ $# -gt 0 ] || set -- $(cat "$root/native/kernel_tests.txt")
# splatpilot._native comes from the build folder. pytest must not swallow the report (-s).
program='
import importlib.util
import sys
from pathlib import Path

import pytest

library = next(Path(sys.argv[1]).glob("_native*.so"))
spec = importlib.util.spec_from_file_location("splatpilot._native", library)
module = importlib.util.module_from_spec(spec)
spec.loader.exec_module(module)
sys.modules["splatpilot._native"] = module
import splatpilot

splatpilot._native = module
print("sanitized:", module.__file__, flush=True)
sys.exit(pytest.main(["-q", "-s", *sys.argv[2:]]))
'
# The interpreter is not instrumented: the run-time library goes first, and leaks are its own.
cd "$root"
printf '%s\n' "$@" | xargs -n 1 -P "$(nproc)" env \
  LD_PRELOAD="$(${CXX:-c++} -print-file-name=libasan.so) $(${CXX:-c++} -print-file-name=libstdc++.so)" \
  ASAN_OPTIONS=detect_leaks=0 UBSAN_OPTIONS=print_stacktrace=1 "$python" -c "$program" "$build"
echo "sanitized: every test passed"
