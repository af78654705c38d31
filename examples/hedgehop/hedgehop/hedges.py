"""A world: a field with hedges across the way."""

from dataclasses import dataclass

import numpy as np

from splatpilot import register_world
from splatpilot.diagrams.worlds.building_blocks import box, daylight, ground, start_and_goal
from splatpilot.diagrams.worlds.feasibility import draw_feasible
from splatpilot.diagrams.worlds.solids.solid import WorldSpec
from splatpilot.diagrams.worlds.solids.surfaces import FloorPlan


@dataclass
class HedgesConfig:
    """Hedges from side to side, one behind the other."""

    length: float = 24.0  # [m] flyable volume along x: from 0 to length
    width: float = 10.0  # [m] along y, centered on 0
    height: float = 5.0  # [m] along z, from the ground
    hedges: int = 3  # [-]
    tallest: float = 2.5  # [m] height of the tallest hedge; others reach at least half of it

    def validate(self) -> None:
        """Raises ValueError for the first value with which no field can be laid out."""
        if not 1 <= self.hedges <= self.length / 5:
            raise ValueError(f"hedges = {self.hedges} must be 1 to {self.length / 5:.0f}, 5 m each")
        if not 0.5 <= self.tallest <= self.height - 1.5:
            raise ValueError(f"tallest = {self.tallest} m must be 0.5 to {self.height - 1.5} m")


def hedges_spec(config: HedgesConfig, seed: int) -> WorldSpec:
    """The field that `config` and `seed` determine, as solids, start and goal."""
    config.validate()
    plan, half = (
        FloorPlan.of_size(config.length, config.width, config.height),
        config.width / 2,
    )

    def draw(rng: np.random.Generator) -> WorldSpec:
        p_WS, p_WG = start_and_goal(plan, rng)
        hedges = []
        for x in np.linspace(0, config.length, config.hedges + 2)[1:-1]:
            top = config.tallest * rng.uniform(0.5, 1.0)
            hedges.append(box([x, -half, 0], [x + 0.5, half, top], "foliage", int(x)))
        _, light = daylight(rng)
        solids = [ground("tiles"), *hedges]
        return WorldSpec("hedges", plan.lower, plan.upper, solids, p_WS, p_WG, light, seed)

    return draw_feasible(draw, seed)


register_world(HedgesConfig, make_spec=hedges_spec)
