"""Blueprints: procedural worlds before anything is drawn, cheap to make."""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from splatpilot.diagrams.worlds.plot import Plot
from splatpilot.diagrams.worlds.solids.illumination import Illumination
from splatpilot.diagrams.worlds.solids.solid import Solid
from splatpilot.systems.collision.analytic_distance_field import AnalyticDistanceField
from splatpilot.systems.collision.esdf import Esdf
from splatpilot.systems.splats.gaussian_scene import GaussianScene

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Blueprint:
    """Everything of a procedural world, in W, from which Gaussians, distances and meshes come."""

    name: str
    lower_W: Array  # (3,) [m], flyable volume
    upper_W: Array  # (3,) [m]
    solids: list[Solid]  # what can be hit, and is seen
    p_WS: Array  # (3,) [m], start
    p_WG: Array  # (3,) [m], goal
    light: Callable[[Esdf], Illumination]  # the light, given a grid of the distances
    seed: int = 0
    voxel_size: float = 0.15  # [m], of the distance grid
    # Solids so far outside the volume that its ground or walls are always nearer.
    scenery: list[Solid] = field(default_factory=list)
    # Draws what else is out of reach: leaves overhead, bushes and trees around the volume.
    surroundings: Callable[[], list[GaussianScene]] = list
    # Draws all that cameras see; by default the solids in their materials, and the surroundings.
    gaussians: Callable[[Illumination], GaussianScene] | None = None

    @property
    def distance_field(self) -> AnalyticDistanceField:
        """The exact distances of the solids in the volume."""
        return AnalyticDistanceField(
            [solid.shape for solid in self.solids], self.lower_W, self.upper_W
        )

    @property
    def plot(self) -> Plot:
        """The volume, seen from above."""
        return Plot(self.lower_W, self.upper_W)
