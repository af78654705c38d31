"""Worlds from OctoMaps: maps that robots made, as coloured blocks."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.ndimage import binary_dilation, gaussian_filter, map_coordinates

from splatpilot.diagrams.worlds.scene import SceneSource, find_scene
from splatpilot.diagrams.worlds.solids.light import GAMMA, Daylight, develop
from splatpilot.diagrams.worlds.solids.surfaces import (
    COVERAGE,
    Surfels,
    perpendicular,
    to_gaussians,
)
from splatpilot.diagrams.worlds.solids.textures import fbm, hash_unit, ramp
from splatpilot.diagrams.worlds.start_and_goal import choose_start_and_goal, draw_start_and_goal
from splatpilot.diagrams.worlds.world import World
from splatpilot.systems.collision.distance_field import FieldState
from splatpilot.systems.collision.esdf import Esdf
from splatpilot.systems.collision.octomap import esdf_from_octomap
from splatpilot.systems.splats.gaussian_scene import GaussianScene
from splatpilot.systems.vehicle.quadrotor_dynamics import VEHICLE_RADIUS


@dataclass
class OctomapConfig(SceneSource):
    """A binary OctoMap (.bt) on disk; `path` is found as that of a scene."""

    lower: list[float] | None = None  # [m] lower corner of the part that is flown in
    upper: list[float] | None = None  # [m] upper corner of that part

    def validate(self) -> None:
        """Raises ValueError for an empty path, or a box with one corner or none in order."""
        super().validate()
        if (self.lower is None) != (self.upper is None):
            raise ValueError("lower and upper must be given both, or neither for all of the map")
        if self.lower is not None and self.upper is not None:
            three = len(self.lower) == len(self.upper) == 3
            if not three or not np.less(self.lower, self.upper).all():
                raise ValueError(f"lower = {self.lower}, upper = {self.upper} m must span a box")


def octomap_world(config: OctomapConfig, seed: int) -> World:
    """Reads the map of `config`; its colours, which it has not, are those of heights.

    Raises:
        FileNotFoundError, ValueError: for a map that is not there, damaged or without free space.
    """
    config.validate()
    path = find_scene(config)
    corners = (None if c is None else np.array(c, float) for c in (config.lower, config.upper))
    esdf = esdf_from_octomap(path, *corners)
    if config.draw_ends:
        p_WS, p_WG, _ = draw_start_and_goal(esdf, VEHICLE_RADIUS, seed)
    else:
        p_WS, p_WG, _ = choose_start_and_goal(esdf, VEHICLE_RADIUS)
    hour = Daylight.sample(np.random.default_rng([seed, 1]))
    return World(
        name=Path(config.path).stem,
        gaussians=voxel_gaussians(esdf, hour),
        distance_field=esdf,
        esdf=esdf,
        background=(float(hour.haze[0]), float(hour.haze[1]), float(hour.haze[2])),
        p_WS=p_WS,
        p_WG=p_WG,
    )


def voxel_gaussians(esdf: Esdf, hour: Daylight) -> GaussianScene:
    """A Gaussian for each occupied voxel that a free one touches, facing where it is free.

    Raises:
        ValueError: if there is none.
    """
    occupied = esdf.states == FieldState.OCCUPIED
    shell = occupied & binary_dilation(esdf.states == FieldState.FREE)
    index = np.argwhere(shell)
    if not len(index):
        raise ValueError("the map has no occupied voxel beside a free one: there is nothing to see")
    p = np.asarray(esdf.lower_W + (index + 0.5) * esdf.voxel_size, dtype=np.float64)
    free = gaussian_filter((~occupied).astype(np.float32), 1.0)
    n = np.stack([map_coordinates(g, index.T, order=0) for g in np.gradient(free)], axis=-1)
    length = np.linalg.norm(n, axis=1, keepdims=True)
    n = np.where(length > 1e-6, n / np.maximum(length, 1e-6), (0.0, 0.0, 1.0)).astype(float)
    low, high = np.percentile(p[:, 2], [1, 99])
    level = (p[:, 2] - low) / max(high - low, 0.5)
    palette = [(0.42, 0.36, 0.30), (0.45, 0.50, 0.38), (0.66, 0.60, 0.48), (0.55, 0.62, 0.68)]
    albedo = ramp(palette, np.clip(level + 0.15 * fbm(p * 0.8, 3, seed=301), 0, 1))
    albedo = albedo * (0.75 + 0.5 * hash_unit(index, seed=302))[:, None]
    colors = develop(albedo**GAMMA * hour.irradiance(n, np.full(len(p), 0.7)))
    # Voxels of a slanted surface are up to sqrt 3 apart: 1.3 times the closed layer's size.
    extent = np.full((len(p), 2), 1.3 * COVERAGE * esdf.voxel_size)
    return to_gaussians(Surfels(p, n, perpendicular(n), extent), colors, 0.99)
