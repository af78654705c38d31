"""What is flown in: what cameras see, the truth about its surfaces, and where to fly."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from splatpilot.systems.collision.distance_field import DistanceField
from splatpilot.systems.collision.esdf import Esdf
from splatpilot.systems.splats.background import Background
from splatpilot.systems.splats.baked_scene import BakedScene
from splatpilot.systems.splats.gaussian_scene import GaussianScene


@dataclass(frozen=True, eq=False)
class World:
    """What is flown in, everything in world frame W (z up, metres)."""

    name: str
    gaussians: GaussianScene  # what cameras see
    # What decides collisions: analytic in procedural worlds, the same object as `esdf` in others.
    distance_field: DistanceField
    esdf: Esdf  # the grid that planners and training read
    background: Background  # what is seen where no Gaussian is
    p_WS: NDArray[np.float64]  # (3,) [m], default start
    p_WG: NDArray[np.float64]  # (3,) [m], default goal

    @cached_property
    def baked(self) -> BakedScene:
        """The Gaussians as cameras render them; made when first asked for, and shared by all."""
        return BakedScene(self.gaussians)
