"""A world: its Gaussians, distance fields, start and goal."""

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from splatpilot.systems.collision.distance_field import DistanceField
from splatpilot.systems.collision.esdf import Esdf
from splatpilot.systems.collision.observations import Observations
from splatpilot.systems.splats.background import Background
from splatpilot.systems.splats.baked_scene import BakedScene
from splatpilot.systems.splats.moving_bodies import MovingObstacles
from splatpilot.systems.splats.scene import GaussianScene


@dataclass(frozen=True, eq=False)
class World:
    """A world to fly in, in frame W (z up, meters); all but `moving` is static."""

    name: str
    gaussians: GaussianScene  # for cameras
    distance_field: DistanceField  # for collisions: analytic, or the same object as `esdf`
    esdf: Esdf  # grid for planners and training
    background: Background  # color of pixels without Gaussians
    p_WS: NDArray[np.float64]  # (3,) [m], default start
    p_WG: NDArray[np.float64]  # (3,) [m], default goal
    moving: MovingObstacles | None = None
    num_frontier: int = 0  # last Gaussians, which close unobserved space
    observations: Observations | None = None  # of the capture; None if not known
    rendered: BakedScene | None = None  # for cameras, instead of the Gaussians
    # The configuration and seed that make this world; `replace` leaves them out.
    source: tuple[Any, int] | None = field(default=None, init=False)

    def __eq__(self, other: object) -> bool:
        """Compares the configurations and seeds that make the worlds, or else the objects."""
        if self.source is None or not isinstance(other, World):
            return self is other
        return self.source == other.source

    def __hash__(self) -> int:
        return hash((self.name, self.source[1])) if self.source else id(self)

    def __reduce_ex__(self, protocol: Any) -> Any:
        """Pickles the configuration and the seed, which make the world again."""
        if self.source is None:
            return super().__reduce_ex__(protocol)
        from splatpilot.diagrams.worlds.world_registry import make_world  # imports this module

        return make_world, self.source

    def __repr__(self) -> str:
        size = " x ".join(f"{length:.3g}" for length in self.esdf.upper_W - self.esdf.lower_W)
        return f"World({self.name!r}: {len(self.gaussians.means):,} Gaussians, {size} m)"

    def field_at(self, time: float) -> DistanceField:
        """Returns the distance field for collisions at a time [s] of a flight."""
        if self.moving is None:
            return self.distance_field
        return self.moving.spheres.among(self.distance_field, time)

    @cached_property
    def baked(self) -> BakedScene:
        """The scene as cameras render it."""
        return self.rendered or BakedScene(self.gaussians)

    def recolored(self, gaussians: GaussianScene, background: Background) -> "World":
        """Returns this world with the colors of `gaussians`; shares the baked geometry."""
        world = replace(self, gaussians=gaussians, background=background)
        vars(world)["baked"] = self.baked.recolored(gaussians.sh)
        return world
