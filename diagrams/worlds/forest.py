"""The embedded world: a seeded forest to fly through, needing no data."""

import numpy as np
from numpy.typing import NDArray

from flysplat.diagrams.worlds import forest_ground, forest_surroundings, forest_trees
from flysplat.diagrams.worlds.forest_config import CLEARANCE, INSET, ForestConfig
from flysplat.diagrams.worlds.forest_layout import MARGIN, lay_out
from flysplat.diagrams.worlds.light import Daylight
from flysplat.diagrams.worlds.surfaces import merged
from flysplat.diagrams.worlds.world import World
from flysplat.systems.collision.analytic_distance_field import AnalyticDistanceField
from flysplat.systems.collision.esdf_build import esdf_from_distance_field


def make_forest(config: ForestConfig, seed: int = 0) -> World:
    """Grows the forest of `config`: the same config and seed give the same bits.

    Trunks stand at Poisson-disk distances, a little tilted; rocks and logs lie between them. From
    this one layout come both the Gaussians that cameras see and the analytic distance field that
    decides about collisions. Leaves are above the flyable volume or flat on the ground, where
    nothing can touch them.

    Start and goal face each other across the length. A way between them exists by construction: any
    two trunks are further apart, at every height, than the vehicle is wide, and one trunk alone
    leaves room beside it (`ForestConfig.validate`). So trunks grown by the vehicle's radius are
    disjoint and cannot close a line from side to side; rocks and logs end below the flight height,
    and no trunk is near start and goal.

    Raises:
        ValueError: for values with which no forest can be grown, or a negative seed.
    """
    config.validate()
    if seed < 0:
        raise ValueError(f"seed = {seed} must be 0 or more")
    # One stream of random numbers per part: a change to one part leaves the others as they are.
    layout_rng, light_rng, *rngs = (np.random.default_rng([seed, k]) for k in range(10))
    p_WS = np.array([INSET, 0.0, config.flight_height])
    p_WG = np.array([config.length - INSET, 0.0, config.flight_height])
    layout = lay_out(config, layout_rng, [p_WS[:2], p_WG[:2]], CLEARANCE)
    light = Daylight.sampled(light_rng)

    shading = layout.outside(layout.trees.base) < config.height

    def sunlit(p: NDArray) -> NDArray:
        trees = layout.trees
        past = light.past_trunks(
            p, trees.at(2.0)[shading, :2], trees.radius[shading], config.height + 3
        )
        return past * light.through_canopy(p, config.height + 3, seed)

    gaussians = merged(
        [
            forest_trees.trunks(layout, light, sunlit, rngs[0]),
            forest_trees.crowns(layout, light, rngs[1]),
            forest_ground.floor(layout, light, sunlit, rngs[2]),
            forest_ground.litter(layout, light, sunlit, rngs[3]),
            *forest_ground.rocks_and_logs(layout, light, sunlit, rngs[4]),
            forest_surroundings.bushes(layout, light, rngs[5]),
            forest_surroundings.edge(layout, light, MARGIN + 3, 9.0, rngs[6]),
            forest_surroundings.edge(layout, light, MARGIN + 9, 13.0, rngs[7]),
        ]
    )
    field = AnalyticDistanceField(layout.shapes(), layout.lower, layout.upper)
    return World(
        name="forest",
        gaussians=gaussians,
        distance_field=field,
        esdf=esdf_from_distance_field(field, config.voxel_size),
        background=(float(light.haze[0]), float(light.haze[1]), float(light.haze[2])),
        p_WS=p_WS,
        p_WG=p_WG,
    )
