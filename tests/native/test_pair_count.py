import shutil
import subprocess
from pathlib import Path

import pytest

PROGRAM = """
#include <cstdio>
#include "project/pair_count.hpp"

int main() {
  splatpilot::check_pair_count(0xffffffffull);
  for (const uint64_t pairs : {0x100000000ull, 0x100000005ull}) {
    try {
      splatpilot::check_pair_count(pairs);
    } catch (const std::length_error& error) {
      std::puts(error.what());
    }
  }
}
"""


@pytest.mark.skipif(shutil.which("c++") is None, reason="needs a C++ compiler")
def test_more_pairs_than_32_bits_count_are_an_error(tmp_path):
    check, native = tmp_path / "check", Path(__file__).parents[2] / "native"
    compiler = ["c++", "-std=c++20", f"-I{native}", "-xc++", "-", "-o", str(check)]
    subprocess.run(compiler, input=PROGRAM, text=True, check=True)
    first, second = subprocess.check_output([check], text=True).splitlines()
    assert first.startswith("the image has 4294967296 pairs")
    assert second.startswith("the image has 4294967301 pairs")
    assert "render a smaller image" in first
