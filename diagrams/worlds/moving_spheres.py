"""Spheres of a scenario that move along waypoints."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from splatpilot.diagrams.worlds.dodgedrone import PERIOD
from splatpilot.diagrams.worlds.world import World
from splatpilot.systems.collision.shapes import MovingSpheres
from splatpilot.systems.common.validation import Config, bounded, require_field
from splatpilot.systems.splats.baked_scene import MovingGaussians
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
    moving = MovingSpheres(radii, paths, PERIOD)
    bodies = [_draw_sphere(radius) for radius in radii]
    obstacles = MovingObstacles(moving, MovingGaussians(bodies, moving.centers))
    if world.moving is not None:
        obstacles = world.moving.merged_with(obstacles)
    return replace(world, moving=obstacles)


def _draw_sphere(radius: float) -> GaussianScene:
    """Returns Gaussians spread evenly over a sphere about the origin."""
    z = 1.0 - 2.0 * (np.arange(_COUNT) + 0.5) / _COUNT
    azimuth = np.arange(_COUNT) * np.pi * (3.0 - np.sqrt(5.0))
    ring = np.sqrt(1.0 - z * z)
    normals = np.column_stack([ring * np.cos(azimuth), ring * np.sin(azimuth), z])
    return GaussianScene.from_colors(
        radius * normals,
        np.tile([1.0, 0.0, 0.0, 0.0], (_COUNT, 1)),
        np.full((_COUNT, 3), 1.2 * radius / np.sqrt(_COUNT)),
        np.full(_COUNT, 0.95),
        # Lighter above.
        np.clip(np.outer(0.8 + 0.3 * z, _COLOR), 0.0, 1.0),
    )
