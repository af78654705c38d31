"""Scenes of colored 3D Gaussians, and their spherical harmonics."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydrake.math import RigidTransform
from scipy.spatial.transform import Rotation

from splatpilot.systems.common.validation import require

C0 = 1.0 / (2.0 * math.sqrt(math.pi))
"""The constant basis function of degree 0."""

MAX_DEGREE = 3


def color_to_sh(color: ArrayLike) -> NDArray[Any]:
    """Returns the coefficients of degree 0 that show colors in [0, 1]."""
    return (np.asarray(color) - 0.5) / C0


def sh_basis(directions: ArrayLike, degree: int) -> NDArray[np.float64]:
    """Evaluates the real spherical harmonics (..., (degree + 1)^2) at unit `directions` (..., 3).

    With the Condon-Shortley phase (Sloan, "Efficient Spherical Harmonic Evaluation", JCGT 2013).
    """
    require(degree in range(MAX_DEGREE + 1), "the degree of spherical harmonics", "0 to 3", degree)
    x, y, z = np.moveaxis(np.asarray(directions, dtype=np.float64), -1, 0)
    xx, yy, zz = x * x, y * y, z * z
    a, b = math.sqrt(3 / (4 * math.pi)), math.sqrt(15 / (4 * math.pi))
    c3, c2, c1 = (math.sqrt(n / math.pi) for n in (35 / 32, 105 / 4, 21 / 32))
    basis = [
        np.full_like(x, C0),
        -a * y,
        a * z,
        -a * x,
        b * x * y,
        -b * y * z,
        math.sqrt(5 / (16 * math.pi)) * (2 * zz - xx - yy),
        -b * x * z,
        b / 2 * (xx - yy),
        -c3 * y * (3 * xx - yy),
        c2 * x * y * z,
        -c1 * y * (4 * zz - xx - yy),
        math.sqrt(7 / (16 * math.pi)) * z * (2 * zz - 3 * xx - 3 * yy),
        -c1 * x * (4 * zz - xx - yy),
        c2 / 2 * z * (xx - yy),
        -c3 * x * (xx - 3 * yy),
    ]
    return np.stack(basis[: (degree + 1) ** 2], axis=-1)


def harmonic_degree(coefficients: int) -> int:
    """Returns the degree of 1, 4, 9 or 16 coefficients: 0, 1, 2 or 3."""
    counts = [(degree + 1) ** 2 for degree in range(MAX_DEGREE + 1)]
    what = "the number of spherical-harmonic coefficients"
    require(coefficients in counts, what, "1, 4, 9 or 16", coefficients)
    return counts.index(coefficients)


def rotated_sh(sh: NDArray, R_WO: ArrayLike) -> NDArray[np.float64]:
    """Returns coefficients (N, K, 3) for directions in W, f_W(d_W) = f_O(R^T d_W), of those in O.

    Samples of the basis in 2l + 1 or more directions determine the matrix of degree l exactly.
    """
    count = 32  # spread directions; 7 would do, more condition the solve
    z = (np.arange(count) + 0.5) / count * 2 - 1
    azimuth = np.arange(count) * np.pi * (3 - np.sqrt(5))
    ring = np.sqrt(1 - z * z)
    d_W = np.stack([ring * np.cos(azimuth), ring * np.sin(azimuth), z], axis=-1)
    degree, rotated = harmonic_degree(sh.shape[1]), np.empty(sh.shape)
    basis_W = sh_basis(d_W, degree)
    basis_O = sh_basis(d_W @ np.asarray(R_WO, dtype=np.float64), degree)  # rows (R^T d)^T
    for l in range(degree + 1):  # noqa: E741
        band = slice(l * l, (l + 1) ** 2)
        matrix = np.linalg.lstsq(basis_W[:, band], basis_O[:, band], rcond=None)[0]
        rotated[:, band] = np.einsum("jk,nkc->njc", matrix, sh[:, band])
    return rotated


def require_valid(
    valid: NDArray[np.bool_], name: str, array: NDArray, condition: str, remedy: str = ""
) -> None:
    """Checks the entries, or rows, of an array; names the first invalid one."""
    if not valid.all():
        first = tuple(int(i) for i in np.argwhere(~valid)[0])
        count = (~valid).reshape(len(valid), -1).any(axis=1).sum()
        got = f"{array[first]} ({count} of {len(valid)} rows are invalid)"
        require(False, f"{name}[{', '.join(map(str, first))}]", condition, got, remedy)


_SHAPES = {"means": (3,), "quats": (4,), "scales": (3,), "opacities": (), "sh": ("K", 3)}
ARRAYS = tuple(_SHAPES)
"""The arrays of a scene, in the order of its arguments."""


@dataclass(frozen=True, eq=False)
class GaussianScene:
    """N Gaussians in one frame, the world W unless said otherwise.

    Gaussian i has the covariance R(quats[i]) diag(scales[i])^2 R(quats[i])^T about means[i], and
    along the unit direction d (from camera to Gaussian) the color
    ``max(0, 0.5 + sum_k basis_k(d) sh[i, k])``, see `sh_basis`. Contiguous float32 arrays are
    shared; do not write into them. Quaternions are normalized.
    """

    means: NDArray[np.float32]  # (N, 3) [m], centers
    quats: NDArray[np.float32]  # (N, 4) wxyz, unit: orientation of the principal axes
    scales: NDArray[np.float32]  # (N, 3) [m], standard deviations along the principal axes
    opacities: NDArray[np.float32]  # (N,) in (0, 1]
    sh: NDArray[np.float32]  # (N, K, 3), K in {1, 4, 9, 16}: coefficients of red, green, blue
    origin: tuple[float, float, float] = field(default=(0.0, 0.0, 0.0), kw_only=True)
    """[m], position of the frame's origin in that of the file, whose Gaussians are far from 0."""
    antialiased: bool = field(default=False, kw_only=True)
    """True if they were trained so that Gaussians narrower than a pixel keep their light, and must
    be rendered so, see `rasterize_mode` of `rasterize`."""

    def __post_init__(self):
        for name, columns in _SHAPES.items():
            array = np.ascontiguousarray(getattr(self, name), dtype=np.float32)
            fits = array.ndim == 1 + len(columns) and all(
                want in ("K", have) for want, have in zip(columns, array.shape[1:], strict=True)
            )
            require(fits, name, f"of shape ({', '.join(map(str, ('N', *columns)))})", array.shape)
            object.__setattr__(self, name, array)
        lengths = {name: len(getattr(self, name)) for name in ARRAYS}
        require(len(set(lengths.values())) == 1, "arrays", "of one length", lengths)
        harmonic_degree(self.sh.shape[1])
        remedy = "remove this Gaussian or repair its file"
        for name in ARRAYS:
            array = getattr(self, name)
            require_valid(np.isfinite(array), name, array, "finite", remedy)
        remedy = "take the exponential of stored logarithms"
        require_valid(self.scales > 0, "scales", self.scales, "> 0 m", remedy)
        valid = (self.opacities > 0) & (self.opacities <= 1)
        remedy = "take the sigmoid of stored logits"
        require_valid(valid, "opacities", self.opacities, "in (0, 1]", remedy)
        norms = np.linalg.norm(self.quats.astype(np.float64), axis=1, keepdims=True)
        remedy = "use (1, 0, 0, 0) for no rotation"
        require_valid(norms[:, 0] >= 1e-12, "quats", self.quats, "of a length > 0", remedy)
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
        """Makes a scene with colors, (N, 3) in [0, 1], that do not depend on the direction."""
        sh = color_to_sh(np.asarray(colors, dtype=np.float64))[:, None, :]
        return cls(means, quats, scales, opacities, sh)  # pyright: ignore[reportArgumentType]

    def __len__(self) -> int:
        return len(self.means)

    def __deepcopy__(self, memo: dict) -> GaussianScene:
        return self  # It does not change.

    @property
    def sh_degree(self) -> int:
        return harmonic_degree(self.sh.shape[1])

    @property
    def base_colors(self) -> NDArray[np.float32]:
        """Colors without their dependence on direction, (N, 3), clipped to [0, 1]."""
        return np.clip(0.5 + C0 * self.sh[:, 0], 0, 1)

    @property
    def rotations(self) -> NDArray[np.float64]:
        """Orientations of the principal axes as matrices, (N, 3, 3)."""
        return Rotation.from_quat(self.quats, scalar_first=True).as_matrix()

    @cached_property
    def normals(self) -> NDArray[np.float32]:
        """Shortest principal axes, (N, 3) unit vectors, of either sign."""
        shortest = self.scales.argmin(axis=1)
        return self.rotations[np.arange(len(self)), :, shortest].astype(np.float32)

    @property
    def covariances(self) -> NDArray[np.float64]:
        """Covariances about the centers, (N, 3, 3) [m^2]."""
        axes = self.rotations * self.scales[:, None, :]
        return axes @ axes.transpose(0, 2, 1)

    def transformed_by(self, X_WO: RigidTransform) -> GaussianScene:
        """Returns these Gaussians, given in frame O, expressed in W."""
        R_WO = X_WO.rotation().matrix()
        rotations = Rotation.from_matrix(R_WO) * Rotation.from_quat(self.quats, scalar_first=True)
        quats = rotations.as_quat(scalar_first=True)
        return replace(
            self,
            means=(self.means @ R_WO.T + X_WO.translation()).astype(np.float32),
            quats=quats.astype(np.float32),
            sh=rotated_sh(self.sh, R_WO).astype(np.float32),
            origin=tuple((R_WO @ self.origin).tolist()),
        )

    def scaled_by(self, factor: float) -> GaussianScene:
        """Returns these Gaussians with all lengths from the origin times `factor`."""
        scale = np.float32(factor)
        origin = tuple((factor * np.array(self.origin)).tolist())
        return replace(self, means=self.means * scale, scales=self.scales * scale, origin=origin)

    def merged_with(self, other: GaussianScene) -> GaussianScene:
        """Returns this scene with the Gaussians of another in its frame; `antialiased` stays."""
        return replace(self, **concatenated([self, other]))


def concatenated(parts: Sequence[Any]) -> dict[str, Any]:
    """Concatenates the `ARRAYS` of scenes or dictionaries; lower degrees of spherical harmonics are
    padded with zeros."""
    rows = [
        part if isinstance(part, dict) else {name: getattr(part, name) for name in ARRAYS}
        for part in parts
    ]
    count = max(row["sh"].shape[1] for row in rows)
    pads = [((0, 0), (0, count - row["sh"].shape[1]), (0, 0)) for row in rows]
    padded = [row | {"sh": np.pad(row["sh"], pad)} for row, pad in zip(rows, pads, strict=True)]
    return {name: np.concatenate([row[name] for row in padded]) for name in ARRAYS}


def choose_origin(positions: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns a new origin (3,) near positions (N, 3) that are far from 0, and 0 for others.

    Far is 1000 m and 1000 times their extent, where a float has steps of 6e-5.
    """
    middle = np.median(positions, axis=0)
    distance = float(np.linalg.norm(middle))
    extent = float(np.median(np.linalg.norm(positions - middle, axis=1)))
    if not distance > 1000.0 * (min(1.0, extent) or 1.0):
        return np.zeros(3)
    # Whole numbers are easy to read, if they are near enough.
    return np.round(middle) if extent > 1 else middle
