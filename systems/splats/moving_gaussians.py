"""Gaussians that move with bodies, placed for one image after another."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from splatpilot.systems.splats.gaussian_scene import GaussianScene


class PlacedGaussians(NamedTuple):
    """N Gaussians in W; float32, see `GaussianScene`. An opacity may be zero."""

    means: NDArray[np.float32]  # (N, 3) [m]
    quats: NDArray[np.float32]  # (N, 4)
    scales: NDArray[np.float32]  # (N, 3) [m]
    opacities: NDArray[np.float32]  # (N,)
    sh: NDArray[np.float32]  # (N, K, 3)


NO_GAUSSIANS = PlacedGaussians(
    *(np.zeros(shape, np.float32) for shape in ((0, 3), (0, 4), (0, 3), (0,), (0, 1, 3)))
)


class MovingGaussians:
    """M bodies of Gaussians that move without turning.

    Args:
        bodies: each about its own centre; all of one degree of spherical harmonics.
        centers: from a time [s] to where the centres are, (M, 3) [m]; infinite for a body that is
            nowhere.
    """

    def __init__(
        self, bodies: Sequence[GaussianScene], centers: Callable[[float], NDArray]
    ) -> None:
        self._about_centers = PlacedGaussians(
            *(
                np.concatenate([getattr(body, name) for body in bodies] or [none])
                for name, none in NO_GAUSSIANS._asdict().items()
            )
        )
        self._body = np.repeat(np.arange(len(bodies)), [len(body) for body in bodies])
        self._centers = centers

    def at(self, time: float) -> PlacedGaussians:
        """The Gaussians at a time [s]; those of bodies that are nowhere have no opacity."""
        centers = self._centers(time)
        present = np.isfinite(centers).all(axis=1)
        own = self._about_centers
        offsets = np.where(present[:, None], centers, 0.0).astype(np.float32)
        placed = own._replace(means=own.means + offsets[self._body])
        if present.all():
            return placed
        return placed._replace(opacities=own.opacities * present[self._body])
