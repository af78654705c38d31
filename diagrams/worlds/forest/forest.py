"""The embedded world: a seeded forest to fly through, needing no data."""

from collections.abc import Sequence

import numpy as np

from splatpilot.diagrams.worlds.building_blocks import CLEARING, INSET
from splatpilot.diagrams.worlds.forest import scenery as ground
from splatpilot.diagrams.worlds.forest import scenery as surroundings
from splatpilot.diagrams.worlds.forest import scenery as trees
from splatpilot.diagrams.worlds.forest.layout import MARGIN, ForestConfig, TrunksConfig, lay_out
from splatpilot.diagrams.worlds.forest.scenery import ForestLight
from splatpilot.diagrams.worlds.solids.shading import Daylight
from splatpilot.diagrams.worlds.solids.solid import WorldSpec
from splatpilot.diagrams.worlds.solids.surfaces import merge
from splatpilot.systems.common.seeds import check_seed
from splatpilot.systems.splats.scene import GaussianScene


def forest_spec(config: ForestConfig, seed: int) -> WorldSpec:
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
    return Forest(config, seed).spec()


class Forest:
    """What `config` and `seed` determine of a forest: where things stand, and the light.

    Raises:
        ValueError: see `forest_spec`.
    """

    def __init__(self, config: TrunksConfig, seed: int) -> None:
        config.validate()
        check_seed(seed)
        self.config, self.seed = config, seed
        # One stream of random numbers a part: a change to one part leaves the others as they are.
        layout_rng, light_rng = (np.random.default_rng([seed, k]) for k in range(2))
        self.p_WS = np.array([INSET, 0.0, config.flight_height])
        self.p_WG = np.array([config.length - INSET, 0.0, config.flight_height])
        self.layout = lay_out(config, layout_rng, [self.p_WS[:2], self.p_WG[:2]], CLEARING)
        self.light = ForestLight(Daylight.sample(light_rng), self.layout, seed)

    def spec(self) -> WorldSpec:
        """The forest before anything is drawn."""
        solids, scenery = self.layout.solids()
        return WorldSpec(
            name="forest",
            lower_W=self.layout.lower,
            upper_W=self.layout.upper,
            solids=solids,
            scenery=scenery,
            p_WS=self.p_WS,
            p_WG=self.p_WG,
            light=lambda _: self.light,
            surroundings=lambda: self._surroundings(self._streams()),
            gaussians=lambda _: self.gaussians(),
            seed=self.seed,
            voxel_size=self.config.voxel_size,
        )

    def gaussians(self) -> GaussianScene:
        """What cameras see."""
        layout, light, rngs = self.layout, self.light, self._streams()
        crowns, *around = self._surroundings(rngs)
        return merge(
            [
                trees.trunks(layout, light, rngs[0]),
                crowns,
                ground.floor(layout, light, rngs[2]),
                ground.litter(layout, light, rngs[3]),
                *ground.rocks_and_logs(layout, light, rngs[4]),
                *around,
            ]
        )

    def _streams(self) -> Sequence[np.random.Generator]:
        return [np.random.default_rng([self.seed, k]) for k in range(2, 10)]

    def _surroundings(self, rngs: Sequence[np.random.Generator]) -> list[GaussianScene]:
        """Crowns, bushes and the far edge of the trees."""
        layout, daylight = self.layout, self.light.daylight
        return [
            trees.crowns(layout, daylight, rngs[1]),
            surroundings.bushes(layout, daylight, rngs[5]),
            surroundings.edge(layout, daylight, MARGIN + 3, 9.0, rngs[6]),
            surroundings.edge(layout, daylight, MARGIN + 9, 13.0, rngs[7]),
        ]
