"""A world: a field with hedges across the route."""

from dataclasses import dataclass

import numpy as np

from splatpilot import Config, bounded, register_world
from splatpilot.diagrams.worlds.building_blocks import box, daylight, ground, start_and_goal
from splatpilot.diagrams.worlds.feasibility import until_feasible
from splatpilot.diagrams.worlds.solids.solid import WorldSpec
from splatpilot.diagrams.worlds.solids.surfaces import FloorPlan
from splatpilot.systems.common.validation import require_field


@dataclass
class HedgesConfig(Config):
    """Hedges from side to side, one behind the other."""

    length: float = bounded(24.0, "[5, 200] m")  # of the volume along x, from 0
    width: float = bounded(10.0, "[3, 200] m")  # along y, centered on 0
    height: float = bounded(5.0, "[2, 50] m")  # along z, from the ground
    hedges: int = 3  # number, at least 5 m apart
    tallest: float = 2.5  # [m] height of the tallest hedge; others reach at least half of it

    def check(self) -> None:
        """Checks that the field can be laid out."""
        most, top = int(self.length / 5), self.height - 1.5
        require_field(self, "hedges", 1 <= self.hedges <= most, f"in [1, {most}]")
        require_field(self, "tallest", 0.5 <= self.tallest <= top, f"in [0.5, {top:g}] m")


@until_feasible
def hedges_spec(config: HedgesConfig, seed: int, rng: np.random.Generator) -> WorldSpec:
    """Draws the field as solids, start and goal."""
    plan = FloorPlan.of_size(config.length, config.width, config.height)
    half = config.width / 2
    p_WS, p_WG = start_and_goal(plan, rng)
    hedges = []
    for x in np.linspace(0, config.length, config.hedges + 2)[1:-1]:
        top = config.tallest * rng.uniform(0.5, 1.0)
        hedges.append(box([x, -half, 0], [x + 0.5, half, top], "foliage", int(x)))
    _, light = daylight(rng)
    solids = [ground("tiles"), *hedges]
    return WorldSpec("hedges", plan.lower, plan.upper, solids, p_WS, p_WG, light, seed)


register_world(HedgesConfig, make_spec=hedges_spec)
