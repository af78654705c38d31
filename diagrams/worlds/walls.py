"""Halls with walls across: what defeats whoever only looks at what is near."""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from splatpilot.diagrams.worlds.feasibility import draw_feasible
from splatpilot.diagrams.worlds.fittings import (
    INSET,
    PASSAGE,
    WALL,
    box,
    check_ground,
    check_positive,
    daylight,
    ground,
    hall,
    signs_in,
    signs_on,
    start_and_goal,
)
from splatpilot.diagrams.worlds.forest.surroundings import trees_around
from splatpilot.diagrams.worlds.plot import Plot
from splatpilot.diagrams.worlds.solids.blueprint import Blueprint
from splatpilot.diagrams.worlds.solids.solid import Solid

PATTERNS = "big_wall", "u_trap", "slits", "slalom"

_FACADES = ["brick", "brick", "concrete", "metal", "wood", "plaster"]
_ACROSS = ["brick", "concrete", "metal", "wood", "foliage"]


@dataclass
class WallsConfig:
    """A roofless hall with walls as high as itself in the way."""

    # What stands across: one of big_wall, u_trap, slits, slalom.
    pattern: str = "slalom"
    length: float = 36.0  # [m] flyable volume along x: from 0 to length
    width: float = 14.0  # [m] along y, centred on 0
    height: float = 6.0  # [m] along z
    # [m] of the wall across: all of big_wall, the back of u_trap, each wall of slalom.
    wall: float = 10.4
    depth: float = 6.0  # [m] of the cul-de-sac of u_trap
    walls: int = 4  # [-] walls of slalom, from one side and the other in turn
    # [m] width of the slit in each wall of slits, in the order in which they are met.
    slits: list[float] = field(default_factory=lambda: [1.4, 1.25, 1.1, 1.0])
    voxel_size: float = 0.15  # [m] of the distance grid

    def validate(self) -> None:
        """Raises ValueError for the first value with which no hall can be built."""
        if self.pattern not in PATTERNS:
            raise ValueError(f"pattern = {self.pattern!r} must be one of {', '.join(PATTERNS)}")
        check_positive(self, "length", "width", "height", "wall", "depth", "voxel_size")
        check_ground(self)
        if self.pattern == "slits":
            for slit in self.slits:
                if not PASSAGE <= slit <= self.width / 2:
                    raise ValueError(
                        f"slits = {self.slits} m: each must be {PASSAGE:.2f} m, for the vehicle, "
                        f"to half the width, {self.width / 2:g} m"
                    )
        elif self.wall > self.width - PASSAGE:
            raise ValueError(
                f"wall = {self.wall} m must be at most width - {PASSAGE:.2f} m = "
                f"{self.width - PASSAGE:.2f} m, or it closes the hall"
            )
        if not 1 <= self.walls <= 20:
            raise ValueError(f"walls = {self.walls} must be 1 to 20")
        crossed = {"slits": len(self.slits), "slalom": self.walls}.get(self.pattern, 1)
        least = 2 * INSET + 2.0 * (crossed + 1) + (self.depth if self.pattern == "u_trap" else 0)
        if self.length < least:
            raise ValueError(
                f"length = {self.length} m must be at least {least:g} m for what stands across"
            )


def walls_blueprint(config: WallsConfig, seed: int) -> Blueprint:
    """Builds the hall of `config`.

    `big_wall` leaves a way at either side of one wall, one of them wider; `u_trap` opens a
    cul-de-sac towards the start; the walls of `slits` have one slit each, well aside of the last;
    those of `slalom` leave a way at one side and the other in turn.

    Raises:
        ValueError: for values with which none can be built, or without a way through.
    """
    config.validate()
    plot = Plot.of_size(config.length, config.width, config.height)

    def draw(rng: np.random.Generator) -> Blueprint:
        p_WS, p_WG = start_and_goal(plot, rng)
        across = {"big_wall": _big_wall, "u_trap": _u_trap, "slits": _slits, "slalom": _slalom}
        if config.pattern in ("big_wall", "u_trap"):  # both stand in the straight way
            p_WS[1], p_WG[1] = 0.3 * p_WS[1], 0.3 * p_WG[1]
        obstacles = across[config.pattern](config, rng)
        sides = hall(plot, _FACADES, rng)
        signs = signs_in(sides, 3, 1, rng)
        for wall in obstacles:
            signs += signs_on(wall, 0, 1, rng)
        hour, light = daylight(rng)
        floor = ("paving", "grass", "concrete")[rng.integers(3)]
        return Blueprint(
            name=config.pattern,
            lower_W=plot.lower,
            upper_W=plot.upper,
            solids=[ground(floor), *sides, *obstacles, *signs],
            p_WS=p_WS,
            p_WG=p_WG,
            light=light,
            surroundings=trees_around(plot, hour, seed),
            seed=seed,
            voxel_size=config.voxel_size,
        )

    return draw_feasible(draw, seed)


def _across(config: WallsConfig, x: float, y0: float, y1: float, material: str, seed: int) -> Solid:
    """A wall across the hall, its middle at x, from y0 to y1 [m]."""
    return box((x - WALL / 2, y0, 0), (x + WALL / 2, y1, config.height), material, seed)


def _material(rng: np.random.Generator) -> tuple[str, int]:
    return _ACROSS[rng.integers(len(_ACROSS))], int(rng.integers(1000))


def _big_wall(config: WallsConfig, rng: np.random.Generator) -> list[Solid]:
    spare = (config.width - config.wall) / 2  # [m] at either side of a wall in the middle
    x = rng.uniform(0.42, 0.58) * config.length
    y = rng.choice([-1, 1]) * rng.uniform(0.3, 0.7) * spare
    return [_across(config, x, y - config.wall / 2, y + config.wall / 2, *_material(rng))]


def _u_trap(config: WallsConfig, rng: np.random.Generator) -> list[Solid]:
    spare = (config.width - config.wall) / 2
    x = rng.uniform(0.58, 0.66) * config.length
    y = rng.uniform(-0.4, 0.4) * spare
    low, high = y - config.wall / 2, y + config.wall / 2
    material, seed = _material(rng)
    return [
        _across(config, x, low, high, material, seed),
        *(
            box((x - config.depth, a, 0), (x - WALL / 2, a + WALL, config.height), material, seed)
            for a in (low, high - WALL)
        ),
    ]


def _stations(config: WallsConfig, number: int, rng: np.random.Generator) -> NDArray:
    """Places (number,) [m] along x, about evenly between start and goal."""
    step = (config.length - 2 * INSET) / (number + 1)
    return INSET + step * (np.arange(1, number + 1) + rng.uniform(-0.1, 0.1, number))


def _slits(config: WallsConfig, rng: np.random.Generator) -> list[Solid]:
    half = config.width / 2
    walls, last = [], rng.uniform(-half, half)
    for x, slit in zip(_stations(config, len(config.slits), rng), config.slits, strict=True):
        room = half - slit / 2 - 0.5
        draws = rng.uniform(-room, room, 50)
        y = draws[np.argmax(np.abs(draws - last) > 0.25 * config.width)]
        material, seed = _material(rng)
        walls += [
            _across(config, x, -half, y - slit / 2, material, seed),
            _across(config, x, y + slit / 2, half, material, seed),
        ]
        last = y
    return walls


def _slalom(config: WallsConfig, rng: np.random.Generator) -> list[Solid]:
    half, side = config.width / 2, int(rng.integers(2))
    walls = []
    for k, x in enumerate(_stations(config, config.walls, rng)):
        ends = (-half, config.wall - half) if (k + side) % 2 else (half - config.wall, half)
        walls.append(_across(config, x, *ends, *_material(rng)))
    return walls
