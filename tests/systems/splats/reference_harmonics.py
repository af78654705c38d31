"""Colours of spherical harmonics, spelled out."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from splatpilot.systems.splats.scene import degree_of, sh_basis


def evaluate_sh(sh: ArrayLike, directions: ArrayLike) -> NDArray[np.float64]:
    """Returns the sum over the basis, shape (..., 3): a colour is ``max(0, 0.5 + that)``.

    `sh`, shape (..., K, 3) with K in {1, 4, 9, 16}, are coefficients per colour channel, and
    `directions`, shape (..., 3), unit vectors; their leading dimensions broadcast.
    """
    sh = np.asarray(sh, dtype=np.float64)
    degree = degree_of(sh.shape[-2])
    return np.einsum("...k,...kc->...c", sh_basis(directions, degree), sh)
