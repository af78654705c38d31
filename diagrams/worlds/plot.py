"""The ground plan of a flyable volume."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray


@dataclass(frozen=True, eq=False)
class Plot:
    """A flyable volume, seen from above."""

    lower: NDArray[np.float64]  # (3,) [m], in W
    upper: NDArray[np.float64]  # (3,) [m]

    def outside(self, p: ArrayLike) -> NDArray[np.float64]:
        """Returns how far p (N, 2 or more) [m] are from the volume in plan, (N,), 0 inside."""
        p = np.asarray(p)[:, :2]
        beyond = np.maximum(self.lower[:2] - p, p - self.upper[:2])
        return np.linalg.norm(np.clip(beyond, 0, None), axis=1)
