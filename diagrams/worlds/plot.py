"""The ground plan of a flyable volume."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray


@dataclass(frozen=True, eq=False)
class Plot:
    """A flyable volume, seen from above."""

    lower: NDArray[np.float64]  # (3,) [m], in W
    upper: NDArray[np.float64]  # (3,) [m]

    @classmethod
    def of_size(cls, length: float, width: float, height: float) -> "Plot":
        """The volume from x = 0 to length, centred on y = 0, on the ground z = 0, all in [m]."""
        return cls(np.array([0.0, -width / 2, 0.0]), np.array([length, width / 2, height]))

    def outside(self, p: ArrayLike) -> NDArray[np.float64]:
        """How far p (N, 2 or more) [m] are from the volume in plan, (N,), 0 inside."""
        p = np.asarray(p)[:, :2]
        beyond = np.maximum(self.lower[:2] - p, p - self.upper[:2])
        return np.linalg.norm(np.clip(beyond, 0, None), axis=1)

    def is_faced(self, p: NDArray, n: NDArray) -> NDArray[np.bool_]:
        """Whether surfaces at p (N, 3) [m] with normals n (N, 3) face any point of the volume."""
        corner = np.where(n > 0, self.upper, self.lower)
        return np.einsum("nk,nk->n", n, corner - p) > 1e-9
