"""A roofed hall with barriers to climb over and to duck under, in turn."""

from dataclasses import dataclass

import numpy as np

from splatpilot.diagrams.worlds.feasibility import draw_feasible
from splatpilot.diagrams.worlds.fittings import (
    INSET,
    PASSAGE,
    WALL,
    box,
    check_ground,
    check_positive,
    ground,
    hall,
    lamplight,
    roof,
    signs_in,
    signs_on,
    start_and_goal,
)
from splatpilot.diagrams.worlds.plot import Plot
from splatpilot.diagrams.worlds.solids.blueprint import Blueprint

_MATERIALS = ["brick", "concrete", "hazard", "wood", "metal"]


@dataclass
class OverUnderConfig:
    """A roofed hall; its barriers stand wall to wall."""

    length: float = 36.0  # [m] flyable volume along x: from 0 to length
    width: float = 16.0  # [m] along y, centred on 0
    height: float = 6.0  # [m] along z, from the floor to the roof
    barriers: int = 5  # [-] over and under in turn; which comes first is drawn
    over: float = 2.8  # [m] height of barriers that stand on the floor
    under: float = 1.9  # [m] height of the lower edge of barriers that hang from the roof
    voxel_size: float = 0.15  # [m] of the distance grid

    def validate(self) -> None:
        """Raises ValueError for the first value with which no hall can be built."""
        check_positive(self, "length", "width", "height", "over", "under", "voxel_size")
        check_ground(self)
        if self.over > self.height - PASSAGE:
            raise ValueError(
                f"over = {self.over} m must be at most height - {PASSAGE:.2f} m = "
                f"{self.height - PASSAGE:.2f} m, or nothing fits under the roof"
            )
        if not PASSAGE <= self.under < self.height:
            raise ValueError(
                f"under = {self.under} m must be {PASSAGE:.2f} m, for the vehicle, to below the "
                f"height, {self.height:g} m"
            )
        least = 2 * INSET + 2.5 * (self.barriers + 1)
        if not 1 <= self.barriers <= 50 or self.length < least:
            raise ValueError(
                f"barriers = {self.barriers} must be 1 to 50 and need a length of {least:g} m; it "
                f"is {self.length:g} m"
            )


def over_under_blueprint(config: OverUnderConfig, seed: int) -> Blueprint:
    """Builds the hall of `config`.

    Raises:
        ValueError: for values with which none can be built, or without a way through.
    """
    config.validate()
    plot = Plot.of_size(config.length, config.width, config.height)

    def draw(rng: np.random.Generator) -> Blueprint:
        p_WS, p_WG = start_and_goal(plot, rng)
        half, step = config.width / 2, (config.length - 2 * INSET) / (config.barriers + 1)
        first = int(rng.integers(2))
        barriers = []
        for k in range(config.barriers):
            x = INSET + step * (k + 1 + rng.uniform(-0.08, 0.08))
            low, high = (0.0, config.over) if (k + first) % 2 else (config.under, config.height)
            corners = (x - WALL / 2, -half, low), (x + WALL / 2, half, high)
            material = _MATERIALS[rng.integers(len(_MATERIALS))]
            barriers.append(box(*corners, material, int(rng.integers(1000))))
        sides = hall(plot, ["plaster", "brick", "concrete", "metal"], rng)
        signs = [s for wall in barriers for s in signs_on(wall, 0, 2, rng)]
        signs += signs_in(sides, 3, 0, rng)
        return Blueprint(
            name="over_under",
            lower_W=plot.lower,
            upper_W=plot.upper,
            solids=[
                ground(("tiles", "concrete")[rng.integers(2)], int(rng.integers(10))),
                roof(plot),
                *sides,
                *barriers,
                *signs,
            ],
            p_WS=p_WS,
            p_WG=p_WG,
            light=lamplight(plot, rng),
            seed=seed,
            voxel_size=config.voxel_size,
        )

    return draw_feasible(draw, seed)
