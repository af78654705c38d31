"""A world: its Gaussians, distance fields, start and goal."""

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
    """Moving obstacles, as functions of time alone."""

    balls: MovingSpheres  # for collisions
    gaussians: MovingGaussians  # for cameras


@dataclass(frozen=True, eq=False)
class World:
    """A world to fly in, in frame W (z up, meters); all fields but `moving` are static."""

    name: str
    gaussians: GaussianScene  # for cameras
    # For collisions: analytic in procedural worlds, the same object as `esdf` in others.
    distance_field: DistanceField
    esdf: Esdf  # grid for planners and training
    background: Background  # color of pixels without Gaussians
    p_WS: NDArray[np.float64]  # (3,) [m], default start
    p_WG: NDArray[np.float64]  # (3,) [m], default goal
    moving: MovingBodies | None = None

    def field_at(self, time: float) -> DistanceField:
        """Returns the distance field for collisions at a time [s] of a flight."""
        if self.moving is None:
            return self.distance_field
        return self.moving.balls.among(self.distance_field, time)

    def distances(self, times: NDArray, p_WQ: NDArray) -> NDArray[np.float64]:
        """Computes distances (N,) [m] of points p_WQ (N, 3) [m], each at its time, (N,) [s]."""
        if self.moving is None:
            return self.distance_field.distance(p_WQ)
        rows = zip(times, p_WQ, strict=True)
        return np.array([self.field_at(time).distance(p) for time, p in rows])

    @cached_property
    def baked(self) -> BakedScene:
        """The Gaussians as cameras render them, made on first use and shared."""
        return BakedScene(self.gaussians)

    def recolored(self, gaussians: GaussianScene, background: Background) -> "World":
        """Returns this world with the colors of `gaussians`; shares the baked geometry."""
        seen = replace(self, gaussians=gaussians, background=background)
        vars(seen)["baked"] = self.baked.recolored(gaussians.sh)
        return seen
