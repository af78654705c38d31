"""Courses of the DodgeDrone challenge (ICRA 2022): balls in the air, some of which move."""

from dataclasses import dataclass, replace

import numpy as np

from splatpilot.diagrams.worlds.dodgedrone.obstacles import (
    LEVELS,
    PERIOD,
    SEED,
    Obstacle,
    draw_obstacles,
)
from splatpilot.diagrams.worlds.fittings import daylight, ground
from splatpilot.diagrams.worlds.forest.surroundings import trees_around
from splatpilot.diagrams.worlds.plot import Plot
from splatpilot.diagrams.worlds.solids.blueprint import Blueprint
from splatpilot.diagrams.worlds.solids.build import build
from splatpilot.diagrams.worlds.solids.illumination import Illumination
from splatpilot.diagrams.worlds.solids.solid import Solid
from splatpilot.diagrams.worlds.solids.surfels import draw
from splatpilot.diagrams.worlds.world import MovingBodies, World
from splatpilot.systems.collision.moving_balls import MovingBalls
from splatpilot.systems.collision.shapes import Sphere
from splatpilot.systems.splats.gaussian_scene import GaussianScene
from splatpilot.systems.splats.moving_gaussians import MovingGaussians

_PLOT = Plot(np.array([-5.0, -10.0, 0.0]), np.array([65.0, 10.0, 10.0]))
"""The volume that must not be left."""

# The vehicle takes off to 1 m, and must fly 60 m along x. The goal lies 3 m behind, in the middle
# of the height that is kept free: who comes within 3 m of it has arrived.
_P_WS = np.array([0.0, 0.0, 1.0])
_P_WG = np.array([63.0, 0.0, 2.5])

_STANDING, _MOVING = ("stone", "concrete", "metal"), "hazard"


@dataclass
class DodgeDroneConfig:
    """A course of the challenge, on an open field."""

    # easy, medium or hard.
    level: str = "medium"
    # Of the challenge's generator for the course of seed 0; the next one for that of seed 1.
    first_seed: int = SEED
    voxel_size: float = 0.2  # [m] of the distance grid

    def validate(self) -> None:
        """Raises ValueError for the first value with which no course can be made."""
        if self.level not in LEVELS:
            raise ValueError(f"level = {self.level!r} must be one of {', '.join(LEVELS)}")
        if not 0 <= self.first_seed < 2**31:
            raise ValueError(f"first_seed = {self.first_seed} must be 0 to {2**31 - 1}")
        if not 0.05 <= self.voxel_size <= 1.0:
            raise ValueError(f"voxel_size = {self.voxel_size} m must be 0.05 to 1 m")


def dodgedrone_world(config: DodgeDroneConfig, seed: int) -> World:
    """The course of `config` and `seed`: whatever was drawn, also where no way is wide enough.

    Raises:
        ValueError: for values with which no course can be made.
    """
    config.validate()
    rng = np.random.default_rng([seed, 0])
    obstacles = draw_obstacles(LEVELS[config.level], config.first_seed + seed)
    standing = [o for o in obstacles if len(o.path) == 1 and np.isfinite(o.path).all()]
    moving = [o for o in obstacles if len(o.path) > 1]
    hour, light = daylight(rng)
    blueprint = Blueprint(
        name=f"dodgedrone_{config.level}",
        lower_W=_PLOT.lower,
        upper_W=_PLOT.upper,
        solids=[ground("concrete")]
        + [
            Solid(Sphere(o.path[0], o.radius), _STANDING[rng.integers(3)], int(rng.integers(1000)))
            for o in standing
        ],
        p_WS=_P_WS,
        p_WG=_P_WG,
        light=light,
        surroundings=trees_around(_PLOT, hour, seed),
        seed=seed,
        voxel_size=config.voxel_size,
    )
    world = build(blueprint)
    balls = MovingBalls([o.radius for o in moving], [o.path for o in moving], PERIOD)
    sun = light(world.esdf)
    bodies = [_draw_body(o, blueprint, sun) for o in moving]
    return replace(world, moving=MovingBodies(balls, MovingGaussians(bodies, balls.centers)))


def _draw_body(obstacle: Obstacle, course: Blueprint, light: Illumination) -> GaussianScene:
    """The Gaussians of a ball that moves, about its centre, lit as where it first is."""
    present = obstacle.path[np.isfinite(obstacle.path).all(axis=1)]
    center = present[0] if len(present) else course.p_WS
    solid = Solid(Sphere(center, obstacle.radius), _MOVING)
    # It is seen from all sides sooner or later, and nothing hides it for ever.
    alone = replace(
        course, solids=[solid], lower_W=course.lower_W - 100.0, upper_W=course.upper_W + 100.0
    )
    body = draw(alone, [solid], light)
    return replace(body, means=body.means - center.astype(np.float32))
