"""Moving spheres: those of a scenario, and courses of the DodgeDrone challenge (ICRA 2022)."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from splatpilot.diagrams.worlds.building_blocks import daylight, ground
from splatpilot.diagrams.worlds.forest.forest import trees_around
from splatpilot.diagrams.worlds.solids.solid import Solid, WorldSpec, build, draw
from splatpilot.diagrams.worlds.solids.surfaces import FloorPlan, even_directions
from splatpilot.diagrams.worlds.world import World
from splatpilot.systems.collision.shapes import MovingSpheres, Sphere
from splatpilot.systems.common.validation import Config, bounded, require_field
from splatpilot.systems.splats.moving_bodies import MovingObstacles
from splatpilot.systems.splats.scene import GaussianScene

_COLOR = 0.9, 0.35, 0.1
_COUNT = 400  # Gaussians of a sphere


@dataclass
class MovingSphere(Config):
    """A sphere that follows waypoints back and forth at constant speed."""

    # [m] Waypoints in the world frame, x, y, z each; the first is its start.
    waypoints: list[list[float]] = bounded(lambda: [[0.0, 0.0, 0.0]], "(-inf, inf) m")
    # [m] Radius.
    radius: float = bounded(0.3, "(0, 100] m")
    # [m/s] Speed.
    speed: float = bounded(1.0, "(0, 100] m/s")

    def check(self) -> None:
        valid = self.waypoints and all(len(point) == 3 for point in self.waypoints)
        require_field(self, "waypoints", valid, "at least one of x, y, z [m]")

    def path(self) -> NDArray[np.float64]:
        """Returns a position (n, 3) [m] per `PERIOD`, up to the last waypoint."""
        points = np.array(self.waypoints)
        lengths = np.linalg.norm(np.diff(points, axis=0), axis=1)
        traveled = np.concatenate([[0.0], np.cumsum(lengths)])
        samples = np.append(np.arange(0.0, traveled[-1], self.speed * PERIOD), traveled[-1])
        return np.column_stack([np.interp(samples, traveled, x) for x in points.T])


def add_moving_spheres(world: World, spheres: Mapping[str, MovingSphere]) -> World:
    """Returns the world with the spheres, at least one, among its moving obstacles."""
    radii, paths = zip(*((each.radius, each.path()) for each in spheres.values()), strict=True)
    bodies = [_draw_sphere(radius) for radius in radii]
    obstacles = MovingObstacles(MovingSpheres(radii, paths, PERIOD), bodies)
    if world.moving is not None:
        obstacles = world.moving.merged_with(obstacles)
    return replace(world, moving=obstacles)


def _draw_sphere(radius: float) -> GaussianScene:
    """Returns Gaussians spread evenly over a sphere about the origin."""
    normals = even_directions(_COUNT)
    return GaussianScene.from_colors(
        radius * normals,
        np.tile([1.0, 0.0, 0.0, 0.0], (_COUNT, 1)),
        np.full((_COUNT, 3), 1.2 * radius / np.sqrt(_COUNT)),
        np.full(_COUNT, 0.95),
        # Lighter above.
        np.clip(np.outer(0.8 + 0.3 * normals[:, 2], _COLOR), 0.0, 1.0),
    )


Array = NDArray[np.float64]
type Triple = tuple[float, float, float]

SEED = 20220301  # Published seed of the generator
PERIOD = 0.02  # [s] between the rows of a path
_ROWS = 1500  # of a path that never leaves its region: 30 s
# [m] Corners of the boxes about start and target in which obstacles vanish.
_KEPT_FREE = ((-3.0, -3.0, 0.0), (3.0, 3.0, 5.0)), ((57.0, -3.0, 0.0), (61.0, 3.0, 5.0))


@dataclass(frozen=True)
class Group:
    """Obstacles of one distribution."""

    count: int
    lower: Triple  # [m], corners of the region of their centers
    upper: Triple
    diameters: tuple[float, float]  # [m], minimum and maximum
    speed: Triple = (0.0, 0.0, 0.0)  # [m/s], maximum initial one along each axis; zero: static
    acceleration: float = 0.0  # [m/s^2], maximum along each axis, drawn per row


@dataclass(frozen=True, eq=False)
class Obstacle:
    """A sphere and its path."""

    radius: float  # [m]
    path: Array  # (rows, 3) [m], one row if it is static; infinite while absent


_ALL = (0.0, -10.0, 0.0), (60.0, 10.0, 10.0)
_FROM_20 = (20.0, -10.0, 0.0), (60.0, 10.0, 10.0)
_FROM_40 = (40.0, -10.0, 0.0), (60.0, 10.0, 10.0)
_ANY, _MIDDLE, _SMALL = (0.1, 3.0), (0.5, 2.0), (0.5, 1.5)

LEVELS: dict[str, tuple[Group, ...]] = {
    "easy": (Group(76, *_ALL, _ANY), Group(9, *_FROM_20, _MIDDLE, (5.0, 5.0, 2.0))),
    "medium": (
        Group(384, *_ALL, _ANY),
        Group(88, *_FROM_20, _MIDDLE, (1.0, 1.0, 1.0)),
        Group(84, *_FROM_40, _ANY),
        Group(44, *_FROM_40, _SMALL, (1.0, 1.0, 1.0), 5.0),
    ),
    "hard": (
        Group(246, (0.0, -10.0, 0.0), (30.0, 10.0, 10.0), _ANY),
        Group(132, *_ALL, _ANY),
        Group(328, *_FROM_20, _MIDDLE, (3.0, 3.0, 2.0)),
        Group(50, (40.0, -4.0, 0.0), (60.0, 4.0, 10.0), _SMALL, (1.0, 1.0, 1.0), 10.0),
    ),
}
"""The levels: medium of the published configuration, easy and hard of the published lists."""


def draw_obstacles(groups: tuple[Group, ...], seed: int) -> list[Obstacle]:
    """Draws the obstacles of all groups in order."""
    rng = np.random.RandomState(seed)
    return [_draw(group, rng) for group in groups for _ in range(group.count)]


def _draw(group: Group, rng: np.random.RandomState) -> Obstacle:
    moves, accelerates = any(group.speed), group.acceleration > 0
    rows, speed = _ROWS if moves else 1, np.array(group.speed)
    lower, upper = np.array(group.lower), np.array(group.upper)
    diameter = rng.uniform(*group.diameters)
    acceleration = np.zeros((rows, 3))
    if accelerates:
        acceleration = rng.rand(rows, 3) * 2 * group.acceleration - group.acceleration
        rng.rand(3)  # body rates
    velocity = np.zeros(3)
    if moves:
        velocity = rng.rand(3) * 2 * speed - speed
    rng.rand(3)  # attitude
    start = rng.rand(3) * (upper - lower) + lower
    velocities = velocity + np.cumsum(acceleration, axis=0) * PERIOD
    path = start + np.cumsum(velocities, axis=0) * PERIOD
    outside = ((path > upper) | (path < lower)).any(axis=1)
    if outside.any():
        path = path[: max(1, int(np.argmax(outside)))]
    for low, high in _KEPT_FREE:
        path[((path > low) & (path < high)).all(axis=1)] = np.inf
    return Obstacle(diameter / 2, path)


_VOLUME = FloorPlan(np.array([-5.0, -10.0, 0.0]), np.array([65.0, 10.0, 10.0]))

# By the rules, the vehicle takes off to 1 m and flies 60 m along x. The goal is 3 m farther, its
# radius 3 m.
_P_WS = np.array([0.0, 0.0, 1.0])
_P_WG = np.array([63.0, 0.0, 2.5])

_STATIC, _MOVING = ("stone", "concrete", "metal"), "hazard"


@dataclass
class DodgeDroneConfig(Config):
    """A course of the challenge, on an open field."""

    # Density and speed of the obstacles.
    level: str = bounded("medium", f"{{{', '.join(LEVELS)}}}")
    # Seed of the challenge's generator for the course of seed 0, plus 1 for that of seed 1.
    first_seed: int = bounded(SEED, f"[0, {2**31 - 1}]")
    voxel_size: float = bounded(0.2, "[0.05, 1] m")  # [m] of the distance grid


def dodgedrone_world(config: DodgeDroneConfig, seed: int) -> World:
    """Returns the course of `config` and `seed`, feasible or not."""
    rng = np.random.default_rng([seed, 0])
    obstacles = draw_obstacles(LEVELS[config.level], config.first_seed + seed)
    static = [o for o in obstacles if len(o.path) == 1 and np.isfinite(o.path).all()]
    moving = [o for o in obstacles if len(o.path) > 1]
    hour, light = daylight(rng)
    solids = [
        Solid(Sphere(o.path[0], o.radius), _STATIC[rng.integers(3)], int(rng.integers(1000)))
        for o in static
    ]
    spec = WorldSpec(
        name=f"dodgedrone_{config.level}",
        lower_W=_VOLUME.lower,
        upper_W=_VOLUME.upper,
        solids=[ground("concrete"), *solids],
        p_WS=_P_WS,
        p_WG=_P_WG,
        light=light,
        surroundings=trees_around(_VOLUME, hour, seed),
        seed=seed,
        voxel_size=config.voxel_size,
    )
    world = build(spec)
    spheres = MovingSpheres([o.radius for o in moving], [o.path for o in moving], PERIOD)
    sun = light(world.esdf)
    # A large volume, since they are seen from all sides.
    large = {"lower_W": spec.lower_W - 100.0, "upper_W": spec.upper_W + 100.0}
    bodies = []
    for obstacle in moving:  # about their centers, lit as at their first positions
        present = obstacle.path[np.isfinite(obstacle.path).all(axis=1)]
        center = present[0] if len(present) else spec.p_WS
        solid = Solid(Sphere(center, obstacle.radius), _MOVING)
        body = draw(replace(spec, solids=[solid], **large), [solid], sun)
        bodies.append(replace(body, means=body.means - center.astype(np.float32)))
    return replace(world, moving=MovingObstacles(spheres, bodies))
