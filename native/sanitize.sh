#!/bin/sh
# Builds the native module with AddressSanitizer and UndefinedBehaviorSanitizer and runs the splat
# tests against it, beside the installed one:
#
#     native/sanitize.sh [python] [pytest arguments]
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
# The interpreter is not instrumented: the run-time library goes first, leaks are Python's own, and
# splatpilot._native comes from the build folder. pytest must not swallow the report (-s).
cd "$root"
LD_PRELOAD="$(${CXX:-c++} -print-file-name=libasan.so) $(${CXX:-c++} -print-file-name=libstdc++.so)" \
ASAN_OPTIONS=detect_leaks=0 UBSAN_OPTIONS=print_stacktrace=1 PYTHONPATH="$build" \
"$python" - "$@" <<'END'
import importlib.util
import sys
from pathlib import Path

import pytest

library = next(Path(sys.path[1] if sys.path[0] == "" else sys.path[0]).glob("_native*.so"))
spec = importlib.util.spec_from_file_location("splatpilot._native", library)
module = importlib.util.module_from_spec(spec)
spec.loader.exec_module(module)
sys.modules["splatpilot._native"] = module
import splatpilot

splatpilot._native = module
print("sanitized:", module.__file__)
sys.exit(pytest.main([*(sys.argv[1:] or ["tests/systems/splats"]), "-s"]))
END
