"""A place made of coloured 3D Gaussians."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydrake.math import RigidTransform, RotationMatrix
from scipy.spatial.transform import Rotation

# Real spherical harmonics up to degree 3, in the order and signs of 3D Gaussian splatting.
#
# The basis is the real part (order m >= 0) and the imaginary part (m < 0) of the complex harmonics
# with Condon-Shortley phase, times sqrt(2) where m is not 0 (Sloan, "Efficient Spherical Harmonic
# Evaluation", JCGT 2013), listed by degree and then by order from -l to l. A colour is
# ``max(0, 0.5 + sum_k basis_k(direction) sh_k)``, with the direction from the camera to the
# Gaussian.


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


@dataclass(frozen=True, eq=False)
class GaussianScene:
    """N Gaussians in one frame, the world W unless said otherwise; all arrays float32, contiguous.

    Gaussian i has the covariance R(quats[i]) diag(scales[i])^2 R(quats[i])^T about means[i], and
    seen along the unit direction d (from camera to Gaussian) the colour
    ``max(0, 0.5 + sum_k basis_k(d) sh[i, k])`` (see `spherical_harmonics`). Quaternions are
    normalised on construction. Arrays that already are float32 and contiguous are shared, not
    copied: scenes are held by reference, so do not write into them.

    Raises:
        ValueError: for arrays of the wrong shape or of different lengths, values that are not
            finite, scales that are not positive, zero quaternions and opacities outside (0, 1].
            The message names the array, the first bad index, its value and the remedy.
    """

    means: NDArray[np.float32]  # (N, 3) [m], centres
    quats: NDArray[np.float32]  # (N, 4) wxyz, unit: orientation of the principal axes
    scales: NDArray[np.float32]  # (N, 3) [m], standard deviations along the principal axes
    opacities: NDArray[np.float32]  # (N,) in (0, 1]
    sh: NDArray[np.float32]  # (N, K, 3), K in {1, 4, 9, 16}: coefficients of red, green, blue
    origin: tuple[float, float, float] = field(default=(0.0, 0.0, 0.0), kw_only=True)
    """[m], position of the frame's origin in that of the file, whose Gaussians are far from 0."""

    def __post_init__(self):
        shapes = {"means": (3,), "quats": (4,), "scales": (3,), "opacities": (), "sh": (-1, 3)}
        for name, shape in shapes.items():
            array = np.ascontiguousarray(getattr(self, name), dtype=np.float32)
            if array.ndim != 1 + len(shape) or any(
                want not in (-1, have) for want, have in zip(shape, array.shape[1:], strict=True)
            ):
                expected = ", ".join(["N", *("K" if n == -1 else str(n) for n in shape)])
                raise ValueError(
                    f"{name} has shape {array.shape}, expected ({expected}): one row per Gaussian"
                )
            object.__setattr__(self, name, array)
        lengths = {name: len(getattr(self, name)) for name in shapes}
        if len(set(lengths.values())) > 1:
            listed = ", ".join(f"{name} {length}" for name, length in lengths.items())
            raise ValueError(
                f"arrays of different lengths ({listed}): every Gaussian needs one row in each"
            )
        degree_of(self.sh.shape[1])

        for name in shapes:
            array = getattr(self, name)
            _refuse(
                ~np.isfinite(array),
                name,
                array,
                "must be finite",
                "remove this Gaussian or repair the file it comes from",
            )
        _refuse(
            self.scales <= 0,
            "scales",
            self.scales,
            "must be > 0 m",
            "these are standard deviations; take the exponential of stored logarithms first",
        )
        _refuse(
            (self.opacities <= 0) | (self.opacities > 1),
            "opacities",
            self.opacities,
            "must be in (0, 1]",
            "take the sigmoid of stored logits first, and remove invisible Gaussians",
        )
        norms = np.linalg.norm(self.quats.astype(np.float64), axis=1, keepdims=True)
        _refuse(
            norms[:, 0] < 1e-12,
            "quats",
            self.quats,
            "must not be zero",
            "use (1, 0, 0, 0) for no rotation",
        )
        if np.any(np.abs(norms - 1) > 1e-6):
            object.__setattr__(self, "quats", (self.quats / norms).astype(np.float32))

    @classmethod
    def from_colors(
        cls,
        means: ArrayLike,
        quats: ArrayLike,
        scales: ArrayLike,
        opacities: ArrayLike,
        colors: ArrayLike,
    ) -> GaussianScene:
        """Builds a scene whose colours, (N, 3) in 0 to 1, are the same from every direction."""
        sh = (np.asarray(colors, dtype=np.float64) - 0.5) / C0
        return cls(means, quats, scales, opacities, sh[:, None, :])  # pyright: ignore[reportArgumentType]

    def __len__(self) -> int:
        return len(self.means)

    @property
    def sh_degree(self) -> int:
        """Degree of the spherical harmonics, 0 to 3."""
        return degree_of(self.sh.shape[1])

    @property
    def base_colors(self) -> NDArray[np.float32]:
        """Colours without their dependence on direction, (N, 3), clipped to 0 to 1."""
        return np.clip(0.5 + C0 * self.sh[:, 0], 0, 1)

    @property
    def rotations(self) -> NDArray[np.float64]:
        """Orientations of the principal axes as matrices, (N, 3, 3)."""
        return Rotation.from_quat(self.quats, scalar_first=True).as_matrix()

    @cached_property
    def normals(self) -> NDArray[np.float32]:
        """Their shortest principal axes, (N, 3) unit vectors, of either sign."""
        shortest = self.scales.argmin(axis=1)
        return self.rotations[np.arange(len(self)), :, shortest].astype(np.float32)

    @property
    def covariances(self) -> NDArray[np.float64]:
        """Covariances about the centres, (N, 3, 3) [m^2]."""
        axes = self.rotations * self.scales[:, None, :]
        return axes @ axes.transpose(0, 2, 1)

    def transformed_by(self, X_WO: RigidTransform) -> GaussianScene:
        """Returns these Gaussians, standing in frame O, expressed in W."""
        R_WO = X_WO.rotation().matrix()
        sh = np.empty(self.sh.shape)
        for l, matrix in enumerate(rotation_matrices(R_WO, self.sh_degree)):  # noqa: E741
            band = slice(l * l, (l + 1) ** 2)
            sh[:, band] = np.einsum("jk,nkc->njc", matrix, self.sh[:, band])
        return GaussianScene(
            means=(self.means @ R_WO.T + X_WO.translation()).astype(np.float32),
            quats=_multiply(X_WO.rotation(), self.quats).astype(np.float32),
            scales=self.scales,
            opacities=self.opacities,
            sh=sh.astype(np.float32),
            origin=_vector(R_WO @ self.origin),
        )

    def scaled_by(self, factor: float) -> GaussianScene:
        """Returns these Gaussians with all lengths from the origin times `factor`."""
        scale = np.float32(factor)
        means, scales = self.means * scale, self.scales * scale
        origin = _vector(factor * np.array(self.origin))
        return GaussianScene(means, self.quats, scales, self.opacities, self.sh, origin=origin)

    def merged_with(
        self, other: GaussianScene, X_WO: RigidTransform | None = None
    ) -> GaussianScene:
        """Returns this scene with `other`, whose frame O stands at `X_WO` (identity), put into it.

        The result has the higher of the two degrees of spherical harmonics; the lower is padded
        with zeros.
        """
        if X_WO is not None:
            other = other.transformed_by(X_WO)
        K = max(self.sh.shape[1], other.sh.shape[1])
        merged = {
            name: np.concatenate([getattr(self, name), getattr(other, name)])
            for name in ("means", "quats", "scales", "opacities")
        }
        padded = [
            np.pad(scene.sh, ((0, 0), (0, K - scene.sh.shape[1]), (0, 0)))
            for scene in (self, other)
        ]
        return GaussianScene(**merged, sh=np.concatenate(padded), origin=self.origin)


def _vector(p: NDArray[np.float64]) -> tuple[float, float, float]:
    x, y, z = p.tolist()
    return x, y, z


def _refuse(bad: NDArray, name: str, array: NDArray, limit: str, remedy: str) -> None:
    """Raises ValueError for the first entry of `array` with a true value in `bad`."""
    if not bad.any():
        return
    first = tuple(int(i) for i in np.argwhere(bad)[0])
    rows = bad.reshape(len(bad), -1).any(axis=1)
    raise ValueError(
        f"{name}[{', '.join(map(str, first))}] = {array[first]} {limit} "
        f"({rows.sum()} of {len(rows)} Gaussians are bad): {remedy}"
    )


def _multiply(R: RotationMatrix, quats: NDArray) -> NDArray[np.float64]:
    """Returns the quaternions (N, 4) wxyz of R times the rotations `quats`."""
    w, x, y, z = R.ToQuaternion().wxyz()
    left = np.array([[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]])
    return quats @ left.T


_FAR = 1000.0
"""Distance from 0, in meters and in times the extent, at which a float has steps of 6e-5."""


def choose_origin(positions: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns a new origin (3,) near positions (N, 3) that are far from 0, and 0 for others."""
    middle = np.median(positions, axis=0)
    distance = float(np.linalg.norm(middle))
    extent = float(np.median(np.linalg.norm(positions - middle, axis=1)))
    if not distance > _FAR * (min(1.0, extent) or 1.0):
        return np.zeros(3)
    # Whole numbers are easily read, if they are near enough.
    return np.round(middle) if extent > 1 else middle
