"""A generated forest to fly through."""

from collections.abc import Sequence

import numpy as np

from splatpilot.diagrams.worlds.building_blocks import CLEARING, INSET
from splatpilot.diagrams.worlds.forest import scenery
from splatpilot.diagrams.worlds.forest.layout import MARGIN, ForestConfig, TrunksConfig, lay_out
from splatpilot.diagrams.worlds.forest.scenery import ForestLight
from splatpilot.diagrams.worlds.solids.shading import Daylight
from splatpilot.diagrams.worlds.solids.solid import WorldSpec
from splatpilot.diagrams.worlds.solids.surfaces import merge
from splatpilot.systems.common.seeds import check_seed
from splatpilot.systems.splats.scene import GaussianScene


def forest_spec(config: ForestConfig, seed: int) -> WorldSpec:
    """Grows the forest of `config`, bitwise identical for the same seed.

    Gaussians and distance field come from the same layout; leaves are above the flyable volume or
    flat on the ground.

    A path from start to goal exists by construction: any two trunks are farther apart, at every
    height, than the vehicle is wide, and one trunk alone leaves space beside it
    (`TrunksConfig.check`). So trunks grown by the vehicle's radius are disjoint and cannot close a
    line from side to side; rocks and logs end below the flight height, and no trunk is near start
    and goal.
    """
    return Forest(config, seed).spec()


class Forest:
    """Layout and light of the forest of `config` and `seed`."""

    def __init__(self, config: TrunksConfig, seed: int) -> None:
        config.validate()
        check_seed(seed)
        self.config, self.seed = config, seed
        # A stream of random numbers per part, so that parts change independently.
        layout_rng, light_rng = (np.random.default_rng([seed, k]) for k in range(2))
        self.p_WS = np.array([INSET, 0.0, config.flight_height])
        self.p_WG = np.array([config.length - INSET, 0.0, config.flight_height])
        self.layout = lay_out(config, layout_rng, [self.p_WS[:2], self.p_WG[:2]], CLEARING)
        self.light = ForestLight(Daylight.sample(light_rng), self.layout, seed)

    def spec(self) -> WorldSpec:
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
        """Draws all that cameras see."""
        layout, light, rngs = self.layout, self.light, self._streams()
        crowns, *around = self._surroundings(rngs)
        return merge(
            [
                scenery.trunks(layout, light, rngs[0]),
                crowns,
                scenery.floor(layout, light, rngs[2]),
                scenery.litter(layout, light, rngs[3]),
                *scenery.rocks_and_logs(layout, light, rngs[4]),
                *around,
            ]
        )

    def _streams(self) -> Sequence[np.random.Generator]:
        return [np.random.default_rng([self.seed, k]) for k in range(2, 10)]

    def _surroundings(self, rngs: Sequence[np.random.Generator]) -> list[GaussianScene]:
        """Draws crowns, bushes and the distant edge of the trees."""
        layout, daylight = self.layout, self.light.daylight
        return [
            scenery.crowns(layout, daylight, rngs[1]),
            scenery.bushes(layout, daylight, rngs[5]),
            scenery.edge(layout, daylight, MARGIN + 3, 9.0, rngs[6]),
            scenery.edge(layout, daylight, MARGIN + 9, 13.0, rngs[7]),
        ]
