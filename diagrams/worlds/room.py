"""A small furnished room."""

from dataclasses import dataclass

import numpy as np

from splatpilot.diagrams.worlds.feasibility import draw_feasible
from splatpilot.diagrams.worlds.fittings import (
    check_count,
    check_ground,
    check_positive,
    check_size,
    ground,
    hall,
    lamplight,
    roof,
    signs_in,
    start_and_goal,
)
from splatpilot.diagrams.worlds.furniture import furnish
from splatpilot.diagrams.worlds.plot import Plot
from splatpilot.diagrams.worlds.solids.blueprint import Blueprint


@dataclass
class RoomConfig:
    """A room with furniture, flown from end to end."""

    length: float = 12.0  # [m] along x: from 0 to length
    width: float = 10.0  # [m] along y, centred on 0
    height: float = 3.2  # [m] along z
    items: int = 16  # [-] pieces of furniture
    voxel_size: float = 0.1  # [m] of the distance grid

    def validate(self) -> None:
        """Raises ValueError for the first value with which no room can be furnished."""
        check_positive(self, "length", "width", "height", "voxel_size")
        check_ground(self)
        check_count(self, "items")
        check_size(self, "room", 6, 4, 2.4)


def room_blueprint(config: RoomConfig, seed: int) -> Blueprint:
    """Furnishes the room of `config`.

    Raises:
        ValueError: for values with which none can be made, or without a way through.
    """
    config.validate()
    plot = Plot.of_size(config.length, config.width, config.height)

    def draw(rng: np.random.Generator) -> Blueprint:
        p_WS, p_WG = start_and_goal(plot, rng, (1.0, min(1.9, config.height - 0.9)))
        inner = plot.lower[:2] + 0.7, plot.upper[:2] - 0.7
        furniture = furnish(config.items, *inner, config.height, [p_WS, p_WG], rng)
        sides = hall(plot, ["plaster", "plaster", "wood", "brick"], rng)
        signs = signs_in(sides, 2, 2, rng)
        floor = ground(("tiles", "wood", "concrete")[rng.integers(3)], int(rng.integers(10)))
        return Blueprint(
            name="room",
            lower_W=plot.lower,
            upper_W=plot.upper,
            solids=[floor, roof(plot), *sides, *signs, *furniture],
            p_WS=p_WS,
            p_WG=p_WG,
            light=lamplight(plot, rng),
            seed=seed,
            voxel_size=config.voxel_size,
        )

    return draw_feasible(draw, seed)
