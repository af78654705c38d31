"""Spheres and boxes strewn over a field or floating in the air."""

from dataclasses import dataclass

import numpy as np
from pydrake.math import RollPitchYaw, RotationMatrix
from scipy.spatial.transform import Rotation

from splatpilot.diagrams.worlds.feasibility import draw_feasible
from splatpilot.diagrams.worlds.fittings import (
    CLEARING,
    check_count,
    check_ground,
    check_positive,
    check_range,
    check_size,
    clear_of,
    daylight,
    ground,
    start_and_goal,
    turned_box,
)
from splatpilot.diagrams.worlds.forest.surroundings import trees_around
from splatpilot.diagrams.worlds.plot import Plot
from splatpilot.diagrams.worlds.solids.blueprint import Blueprint
from splatpilot.diagrams.worlds.solids.solid import Solid
from splatpilot.systems.collision.shapes import Sphere

_BALLS = ["stone", "concrete", "foliage", "hazard", "metal"]
_BOXES = ["crate", "wood", "metal", "hazard", "brick", "concrete", "signage", "fabric"]


@dataclass
class ClutterConfig:
    """An open field with spheres and boxes: upright pillars, or floating boxes turned anyhow."""

    length: float = 36.0  # [m] flyable volume along x: from 0 to length
    width: float = 20.0  # [m] along y, centred on 0
    height: float = 6.0  # [m] along z
    spheres: int = 10  # [-] spheres
    sphere_min: float = 0.6  # [m] smallest radius
    sphere_max: float = 1.8  # [m] largest radius
    boxes: int = 20  # [-] boxes
    half_min: float = 0.3  # [m] smallest half edge of a box
    half_max: float = 0.9  # [m] largest half edge
    # Whether boxes float, turned anyhow. Otherwise they are pillars on the ground, 2 m high at
    # least, that lean up to `lean_max`.
    floating: bool = False
    lean_max: float = 15.0  # [deg] largest tilt of a pillar
    voxel_size: float = 0.15  # [m] of the distance grid

    def validate(self) -> None:
        """Raises ValueError for the first value with which no field can be made."""
        check_positive(self, "length", "width", "height", "voxel_size")
        check_ground(self)
        check_range(self, "sphere_min", "sphere_max")
        check_range(self, "half_min", "half_max")
        check_count(self, "spheres", "boxes")
        if not 0 <= self.lean_max <= 45:
            raise ValueError(f"lean_max = {self.lean_max} deg must be 0 to 45 deg")
        check_size(self, "field", 6, 4, 3)


def clutter_blueprint(config: ClutterConfig, seed: int) -> Blueprint:
    """Strews the field of `config`: obstacles anywhere but near start and goal, overlapping or not.

    Raises:
        ValueError: for values with which none can be made, or without a way through.
    """
    config.validate()
    plot = Plot.of_size(config.length, config.width, config.height)

    def draw(rng: np.random.Generator) -> Blueprint:
        p_WS, p_WG = start_and_goal(plot, rng)
        obstacles: list[Solid] = []
        for make, number in ((_sphere, config.spheres), (_box, config.boxes)):
            for _ in range(number):
                for _ in range(50):  # elsewhere, if it is too near the start or goal
                    solid = make(config, plot, rng)
                    if clear_of(solid.shape, [p_WS, p_WG], CLEARING):
                        obstacles.append(solid)
                        break
        hour, light = daylight(rng)
        return Blueprint(
            name="clutter",
            lower_W=plot.lower,
            upper_W=plot.upper,
            solids=[ground(("grass", "paving", "concrete")[rng.integers(3)]), *obstacles],
            p_WS=p_WS,
            p_WG=p_WG,
            light=light,
            surroundings=trees_around(plot, hour, seed),
            seed=seed,
            voxel_size=config.voxel_size,
        )

    return draw_feasible(draw, seed)


def _sphere(config: ClutterConfig, plot: Plot, rng: np.random.Generator) -> Solid:
    radius = rng.uniform(config.sphere_min, config.sphere_max)
    p = rng.uniform(plot.lower, plot.upper)
    material = _BALLS[rng.integers(len(_BALLS))]
    return Solid(Sphere(p, float(radius)), material, int(rng.integers(1000)))


def _box(config: ClutterConfig, plot: Plot, rng: np.random.Generator) -> Solid:
    half = rng.uniform(config.half_min, config.half_max, 3)
    p = rng.uniform(plot.lower, plot.upper)
    if config.floating:
        turn = RotationMatrix(Rotation.random(rng=rng).as_matrix())
    else:
        lean = np.deg2rad(config.lean_max) * np.sqrt(rng.uniform())
        way = rng.uniform(0, 2 * np.pi)
        turn = RotationMatrix(
            RollPitchYaw(lean * np.cos(way), lean * np.sin(way), rng.uniform(0, np.pi))
        )
        top = rng.uniform(2.0, max(config.height, 2.5))
        half[2] = top / 2 + 0.3
        p[2] = top / 2 - 0.3
    material = _BOXES[rng.integers(len(_BOXES))]
    return turned_box(p, turn, 2 * half, material, int(rng.integers(1000)))
