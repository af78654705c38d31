"""Which of its kernels numpy computes with: the same on every x86-64 processor with AVX2.

numpy, and the OpenBLAS in its wheels, otherwise take the widest that a processor has, which add in
another order and round functions otherwise: a flight would depend on the machine that it is flown
on. They look at the environment once, when numpy is imported.
"""

import os
import sys
from pathlib import Path

KERNELS = {
    # Those of Haswell, which have AVX2, overwrite their stack in the OpenBLAS of numpy 2.5.5.
    "OPENBLAS_CORETYPE": "Sandybridge",
    # All beyond AVX2, by the names of numpy before 2.4 and since.
    "NPY_DISABLE_CPU_FEATURES": "X86_V4 AVX512_ICL AVX512_SPR AVX512F AVX512CD AVX512_SKX "
    "AVX512_CLX AVX512_CNL",
}


def fix_numpy_kernels() -> bool:
    """
    Sets the environment of this process, and of those that it starts, to `KERNELS`.

    Returns:
        Whether numpy computes with them: not if it has been imported before without, or where the
        processor has no AVX2.
    """
    if all(os.environ.get(name) == value for name, value in KERNELS.items()):
        return True
    if "numpy" in sys.modules or not _has_avx2():
        return False
    os.environ.update(KERNELS)
    return True


def _has_avx2() -> bool:
    try:
        return " avx2 " in Path("/proc/cpuinfo").read_text()
    except OSError:
        return False
