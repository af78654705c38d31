"""The embedded world: a seeded forest to fly through, needing no data."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from splatpilot.diagrams.worlds.forest import ground as forest_ground
from splatpilot.diagrams.worlds.forest import surroundings as forest_surroundings
from splatpilot.diagrams.worlds.forest import trees as forest_trees
from splatpilot.diagrams.worlds.forest.config import CLEARANCE, INSET, ForestConfig, TrunksConfig
from splatpilot.diagrams.worlds.forest.layout import MARGIN, ForestLayout, lay_out
from splatpilot.diagrams.worlds.solids.blueprint import Blueprint
from splatpilot.diagrams.worlds.solids.light import Daylight, Sunlit
from splatpilot.diagrams.worlds.solids.surfaces import merged
from splatpilot.diagrams.worlds.solids.textures import smoothstep
from splatpilot.diagrams.worlds.world import World
from splatpilot.systems.collision.esdf import Esdf
from splatpilot.systems.collision.esdf_build import esdf_from_distance_field
from splatpilot.systems.splats.gaussian_scene import GaussianScene


def make_forest(config: ForestConfig, seed: int = 0) -> World:
    """Grows the forest of `config`: the same config and seed give the same bits.

    Trunks stand at Poisson-disk distances, a little tilted; rocks and logs lie between them. From
    this one layout come both the Gaussians that cameras see and the analytic distance field that
    decides about collisions. Leaves are above the flyable volume or flat on the ground, where
    nothing can touch them.

    Start and goal face each other across the length. A way between them exists by construction: any
    two trunks are further apart, at every height, than the vehicle is wide, and one trunk alone
    leaves room beside it (`TrunksConfig.validate`). So trunks grown by the vehicle's radius are
    disjoint and cannot close a line from side to side; rocks and logs end below the flight height,
    and no trunk is near start and goal.

    Raises:
        ValueError: for values with which no forest can be grown, or a negative seed.
    """
    return Forest(config, seed).world()


class Forest:
    """What `config` and `seed` determine of a forest: where things stand, and the light.

    Raises:
        ValueError: see `make_forest`.
    """

    def __init__(self, config: TrunksConfig, seed: int) -> None:
        config.validate()
        if seed < 0:
            raise ValueError(f"seed = {seed} must be 0 or more")
        self.config, self.seed = config, seed
        # One stream of random numbers a part: a change to one part leaves the others as they are.
        layout_rng, light_rng = (np.random.default_rng([seed, k]) for k in range(2))
        self.p_WS = np.array([INSET, 0.0, config.flight_height])
        self.p_WG = np.array([config.length - INSET, 0.0, config.flight_height])
        ends = [self.p_WS[:2], self.p_WG[:2]]
        self.layout: ForestLayout = lay_out(config, layout_rng, ends, CLEARANCE)
        self.light = Daylight.sampled(light_rng)

    def sunlit(self, p: NDArray) -> NDArray:
        """Part of the sun (N,) in [0, 1] that trunks and leaves let through to p (N, 3) [m]."""
        shading, trees, top = self._shading, self.layout.trees, self.config.height + 3
        past = self.light.past_trunks(p, trees.at(2.0)[shading, :2], trees.radius[shading], top)
        return past * self.light.through_canopy(p, top, self.seed)

    @cached_property
    def _shading(self) -> NDArray[np.bool_]:
        return self.layout.outside(self.layout.trees.base) < self.config.height

    def blueprint(self) -> Blueprint:
        """The forest before anything is drawn."""
        solids, scenery = self.layout.solids()
        return Blueprint(
            name="forest",
            lower_W=self.layout.lower,
            upper_W=self.layout.upper,
            solids=solids,
            scenery=scenery,
            p_WS=self.p_WS,
            p_WG=self.p_WG,
            light=lambda _: ForestLight(self.light, self.sunlit),
            surroundings=lambda: self._surroundings(self._streams()),
            seed=self.seed,
            voxel_size=self.config.voxel_size,
        )

    def gaussians(self, esdf: Esdf) -> GaussianScene:
        """What cameras see; `esdf` is the grid of the distances."""
        layout, light, rngs = self.layout, self.light, self._streams()
        crowns, *around = self._surroundings(rngs)
        return merged(
            [
                forest_trees.trunks(layout, light, self.sunlit, rngs[0]),
                crowns,
                forest_ground.floor(layout, light, self.sunlit, rngs[2]),
                forest_ground.litter(layout, light, self.sunlit, rngs[3]),
                *forest_ground.rocks_and_logs(layout, light, self.sunlit, rngs[4]),
                *around,
            ]
        )

    def world(self) -> World:
        """Builds all of it; see `make_forest`."""
        blueprint = self.blueprint()
        field, haze = blueprint.distance_field, self.light.haze
        esdf = esdf_from_distance_field(field, self.config.voxel_size)
        return World(
            name=blueprint.name,
            gaussians=self.gaussians(esdf),
            distance_field=field,
            esdf=esdf,
            background=(float(haze[0]), float(haze[1]), float(haze[2])),
            p_WS=blueprint.p_WS,
            p_WG=blueprint.p_WG,
        )

    def _streams(self) -> Sequence[np.random.Generator]:
        return [np.random.default_rng([self.seed, k]) for k in range(2, 10)]

    def _surroundings(self, rngs: Sequence[np.random.Generator]) -> list[GaussianScene]:
        """Crowns, bushes and the far edge of the trees."""
        layout, light = self.layout, self.light
        return [
            forest_trees.crowns(layout, light, rngs[1]),
            forest_surroundings.bushes(layout, light, rngs[5]),
            forest_surroundings.edge(layout, light, MARGIN + 3, 9.0, rngs[6]),
            forest_surroundings.edge(layout, light, MARGIN + 9, 13.0, rngs[7]),
        ]


@dataclass(frozen=True, eq=False)
class ForestLight:
    """The light of a forest as an `Illumination`."""

    daylight: Daylight
    sunlit: Sunlit

    @property
    def haze(self) -> NDArray[np.float64]:
        return self.daylight.haze

    def irradiance(self, p_W: NDArray, n_W: NDArray) -> NDArray[np.float64]:
        foot = 0.55 + 0.45 * smoothstep(-0.1, 0.5, p_W[:, 2] + np.abs(n_W[:, 2]))
        return self.daylight.irradiance(n_W, self.sunlit(p_W)) * foot[:, None]
