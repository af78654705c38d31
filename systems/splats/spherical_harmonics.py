"""Real spherical harmonics up to degree 3, in the order and signs of 3D Gaussian splatting.

The basis is the real part (order m >= 0) and the imaginary part (m < 0) of the complex harmonics
with Condon-Shortley phase, times sqrt(2) where m is not 0 (Sloan, "Efficient Spherical Harmonic
Evaluation", JCGT 2013), listed by degree and then by order from -l to l. A colour is
``max(0, 0.5 + sum_k basis_k(direction) sh_k)``, with the direction from the camera to the Gaussian.
"""

import math
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

C0 = 0.28209479177387814
"""The constant basis function of degree 0, 1 / (2 sqrt(pi))."""

MAX_DEGREE = 3


def sh_basis(directions: ArrayLike, degree: int) -> NDArray[np.float64]:
    """Returns the basis functions of degrees 0 to `degree`, shape (..., (degree + 1)^2).

    `directions`, shape (..., 3), are unit vectors in the frame in which the coefficients stand.

    Raises:
        ValueError: if `degree` is not 0, 1, 2 or 3.
    """
    if degree not in range(MAX_DEGREE + 1):
        raise ValueError(f"spherical harmonics of degree {degree}: the degree must be 0, 1, 2 or 3")
    directions = np.asarray(directions, dtype=np.float64)
    x, y, z = directions[..., 0], directions[..., 1], directions[..., 2]
    return np.stack(sh_basis_functions(x, y, z, degree), axis=-1)


def sh_basis_functions(x: Any, y: Any, z: Any, degree: int) -> list[Any]:
    """The (degree + 1)^2 basis functions of unit vectors (x, y, z): NumPy arrays or tensors."""
    xx, yy, zz = x * x, y * y, z * z
    basis = [C0 + 0 * x]
    if degree >= 1:
        c = math.sqrt(3 / (4 * math.pi))
        basis += [-c * y, c * z, -c * x]
    if degree >= 2:
        c = math.sqrt(15 / (4 * math.pi))
        basis += [
            c * x * y,
            -c * y * z,
            math.sqrt(5 / (16 * math.pi)) * (2 * zz - xx - yy),
            -c * x * z,
            c / 2 * (xx - yy),
        ]
    if degree >= 3:
        c3, c2, c1 = (math.sqrt(a / math.pi) for a in (35 / 32, 105 / 4, 21 / 32))
        basis += [
            -c3 * y * (3 * xx - yy),
            c2 * x * y * z,
            -c1 * y * (4 * zz - xx - yy),
            math.sqrt(7 / (16 * math.pi)) * z * (2 * zz - 3 * xx - 3 * yy),
            -c1 * x * (4 * zz - xx - yy),
            c2 / 2 * z * (xx - yy),
            -c3 * x * (xx - 3 * yy),
        ]
    return basis


def degree_of(coefficients: int) -> int:
    """Returns the degree that has so many coefficients: 1, 4, 9, 16 give 0, 1, 2, 3.

    Raises:
        ValueError: for any other number.
    """
    for degree in range(MAX_DEGREE + 1):
        if coefficients == (degree + 1) ** 2:
            return degree
    raise ValueError(
        f"{coefficients} spherical-harmonic coefficients: 1, 4, 9 or 16 are needed (degrees 0 to 3)"
    )


def rotation_matrices(R: ArrayLike, degree: int) -> list[NDArray[np.float64]]:
    """Returns, for l = 0 to `degree`, the (2l+1, 2l+1) matrix that rotates degree-l coefficients.

    With `R` = R_WO, shape (3, 3), and coefficients c of a function f of directions in frame O,
    ``M @ c`` are those of the same function in W: f_W(d_W) = f_O(R^T d_W). Each degree is closed
    under rotation, so samples of the basis in as many or more directions determine M exactly.
    """
    R = np.asarray(R, dtype=np.float64)
    count = 32  # spread directions; 7 would do, more condition the solve
    z = (np.arange(count) + 0.5) / count * 2 - 1
    azimuth = np.arange(count) * np.pi * (3 - np.sqrt(5))
    ring = np.sqrt(1 - z * z)
    d_W = np.stack([ring * np.cos(azimuth), ring * np.sin(azimuth), z], axis=-1)
    basis_W = sh_basis(d_W, degree)
    basis_O = sh_basis(d_W @ R, degree)  # rows (R^T d)^T
    matrices = []
    for l in range(degree + 1):  # noqa: E741
        band = slice(l * l, (l + 1) ** 2)
        matrices.append(np.linalg.lstsq(basis_W[:, band], basis_O[:, band], rcond=None)[0])
    return matrices
