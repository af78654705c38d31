import os
import subprocess
import sys
from pathlib import Path

import pytest

from splatpilot.systems.common.numpy_kernels import KERNELS


@pytest.mark.skipif(
    " avx2 " not in Path("/proc/cpuinfo").read_text(), reason="the processor has no AVX2"
)
@pytest.mark.parametrize(
    ("imported", "fixed"), [("splatpilot, numpy", True), ("numpy, splatpilot", False)]
)
def test_numpy_takes_these_kernels_if_it_comes_second(imported, fixed):
    """Imported after splatpilot, numpy computes with AVX2 and no more, whatever the processor has
    and the environment says; imported before, as it would without."""
    script = (
        f"import {imported}\n"
        "from splatpilot.systems.common.numpy_kernels import fix_numpy_kernels\n"
        "from numpy._core._multiarray_umath import __cpu_features__ as features\n"
        "print(fix_numpy_kernels(), features.get('X86_V4', features['AVX512F']))\n"
    )
    environment = {"OPENBLAS_CORETYPE": "SkylakeX"}
    ended = subprocess.run(
        [sys.executable, "-c", script], env=environment, capture_output=True, text=True, check=True
    )
    said, wide = ended.stdout.split()
    assert said == str(fixed)
    assert not fixed or wide == "False"
    assert set(KERNELS) == {"OPENBLAS_CORETYPE", "NPY_DISABLE_CPU_FEATURES"}


@pytest.mark.parametrize("threads", ["1", "2"])
def test_these_kernels_multiply(threads):
    """Products of matrices of any size come out right; OpenBLAS has had kernels that end the
    process where there are more than a few dozen rows."""
    script = (
        "import splatpilot, numpy as np\n"
        "rng = np.random.default_rng(0)\n"
        "for n, k in [(20, 4096), (67, 512), (67, 4096), (300, 300), (1000, 64)]:\n"
        "    a, b = rng.normal(size=(2, n, k))\n"
        "    for x, y in ((a, b), (a, a)):\n"
        "        error = np.abs(x @ y.T - np.einsum('ik,jk->ij', x, y)).max()\n"
        "        assert error < 1e-9 * k, (n, k, error)\n"
    )
    environment = os.environ | {"OPENBLAS_NUM_THREADS": threads}
    subprocess.run([sys.executable, "-c", script], env=environment, check=True)
