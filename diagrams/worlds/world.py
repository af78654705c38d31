"""What is flown in: what cameras see, the truth about its surfaces, and where to fly."""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from splatpilot.systems.collision.distance_field import DistanceField
from splatpilot.systems.collision.esdf import Esdf
from splatpilot.systems.collision.shapes import MovingSpheres
from splatpilot.systems.splats.background import Background
from splatpilot.systems.splats.baked_scene import BakedScene, MovingGaussians
from splatpilot.systems.splats.scene import GaussianScene


@dataclass(frozen=True, eq=False)
class MovingBodies:
    """What moves in a world, as functions of time alone."""

    balls: MovingSpheres  # what is hit
    gaussians: MovingGaussians  # what cameras see of it


@dataclass(frozen=True, eq=False)
class World:
    """What is flown in, everything in world frame W (z up, metres).

    All fields but `moving` are about what stands.
    """

    name: str
    gaussians: GaussianScene  # what cameras see
    # What decides collisions: analytic in procedural worlds, the same object as `esdf` in others.
    distance_field: DistanceField
    esdf: Esdf  # the grid that planners and training read
    background: Background  # what is seen where no Gaussian is
    p_WS: NDArray[np.float64]  # (3,) [m], default start
    p_WG: NDArray[np.float64]  # (3,) [m], default goal
    moving: MovingBodies | None = None

    def field_at(self, time: float) -> DistanceField:
        """What decides collisions at a time [s] of a flight."""
        if self.moving is None:
            return self.distance_field
        return self.moving.balls.among(self.distance_field, time)

    def distances(self, times: NDArray, p_WQ: NDArray) -> NDArray[np.float64]:
        """The distances (N,) [m] of points p_WQ (N, 3) [m], each at its time, (N,) [s]."""
        if self.moving is None:
            return self.distance_field.distance(p_WQ)
        rows = zip(times, p_WQ, strict=True)
        return np.array([self.field_at(time).distance(p) for time, p in rows])

    @cached_property
    def baked(self) -> BakedScene:
        """The Gaussians as cameras render them; made when first asked for, and shared by all."""
        return BakedScene(self.gaussians)

    def recolored(self, gaussians: GaussianScene, background: Background) -> "World":
        """The same place in other colours; what was baked of it is shared.

        Args:
            gaussians: those of this world, but for their colours.
            background: what is seen where none is.
        """
        seen = replace(self, gaussians=gaussians, background=background)
        vars(seen)["baked"] = self.baked.recolored(gaussians.sh)
        return seen
