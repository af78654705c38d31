"""Worlds from files: meshes, and OctoMaps, drawn as colored blocks."""

import logging
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.ndimage import binary_dilation, gaussian_filter, map_coordinates

from splatpilot.diagrams.worlds.building_blocks import MAX_VOXELS
from splatpilot.diagrams.worlds.feasibility import SHORTEST, choose_ends
from splatpilot.diagrams.worlds.scene_folder import SceneSource, find_scene
from splatpilot.diagrams.worlds.solids.surfaces import (
    COVERAGE,
    Surfels,
    perpendicular,
    to_gaussians,
)
from splatpilot.diagrams.worlds.solids.textures import (
    GAMMA,
    Daylight,
    develop,
    fbm,
    hash_unit,
    ramp,
)
from splatpilot.diagrams.worlds.world import World
from splatpilot.systems.collision.distance_field import FieldState
from splatpilot.systems.collision.esdf import Esdf
from splatpilot.systems.collision.octomap import read_octomap
from splatpilot.systems.common.files import find_data
from splatpilot.systems.common.provenance import InfeasibleFlightError
from splatpilot.systems.common.validation import (
    Config,
    bounded,
    errors_about,
    require,
    require_field,
)
from splatpilot.systems.splats.scene import GaussianScene

OCTOMAP = ".bt"  # Suffix of binary OctoMaps

_log = logging.getLogger(__name__)


@dataclass
class OctomapConfig(SceneSource):
    """A binary OctoMap (.bt) on disk; `path` is found like that of a scene."""

    # [m] Lower corner of the part to fly in; by default all of the map, or at most 20 million
    # voxels about the middle of its free space.
    lower: list[float] | None = None
    upper: list[float] | None = None  # [m] Upper corner of that part.

    def check(self) -> None:
        super().check()
        both = (self.lower is None) == (self.upper is None)
        require(both, "lower and upper", "given both, or neither", f"{self.lower}, {self.upper}")
        if self.lower is not None and self.upper is not None:
            sizes = {len(self.lower), len(self.upper)}
            valid = sizes == {3} and np.less(self.lower, self.upper).all()
            require_field(self, "upper", valid, f"above lower = {self.lower} along each axis")


def octomap_world(config: OctomapConfig, seed: int) -> World:
    """Reads the map of `config`, colored by height."""
    path = find_scene(config)
    octomap = read_octomap(path)
    if config.lower is not None and config.upper is not None:
        lower_W, upper_W = np.array(config.lower, float), np.array(config.upper, float)
    else:
        lower_W, upper_W = octomap.part(MAX_VOXELS)
        corners = (lower_W, upper_W, octomap.lower_W, octomap.upper_W)
        if (upper_W - lower_W < octomap.upper_W - octomap.lower_W).any():
            _log.warning(
                "%s is large: using the part from %s to %s of %s to %s m; world.lower and "
                "world.upper choose another",
                config.path,
                *(corner.round(1).tolist() for corner in corners),
            )
    with errors_about(path):
        esdf = octomap.esdf(lower_W, upper_W)
    if not (esdf.states == FieldState.FREE).any():
        raise InfeasibleFlightError(
            f"{path}: no space from {lower_W} to {upper_W} m is known to be free; choose another "
            "map, or another part of it by world.lower and world.upper"
        )
    drawn = {"min_length": config.min_path, "seed": seed} if config.draw_ends else {}
    ends = choose_ends(esdf, config.path, **drawn)
    hour = Daylight.sample(np.random.default_rng([seed, 1]))
    name, haze = Path(config.path).stem, tuple(hour.haze.tolist())
    return World(name, voxel_gaussians(esdf, hour), esdf, esdf, haze, *ends)


def voxel_gaussians(esdf: Esdf, hour: Daylight) -> GaussianScene:
    """Draws a Gaussian in each occupied voxel that touches a free one, facing free space."""
    occupied = esdf.states == FieldState.OCCUPIED
    shell = occupied & binary_dilation(esdf.states == FieldState.FREE)
    index = np.argwhere(shell)
    require(len(index), "number of occupied voxels next to free ones", "at least 1", 0)
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
    surfels = Surfels(p, n, perpendicular(n), extent)
    return to_gaussians(surfels, colors, 0.99)


_PREVIEW = 120_000  # number of Gaussians that show the mesh on pages
_GAP = 1.5  # times the spacing of an even grid, between points drawn at random


@dataclass
class MeshWorld(Config):
    """An environment as a mesh (.glb, .gltf or .obj) on disk; cameras show the mesh itself."""

    path: str = ""  # here, or in the folder of data (SPLATPILOT_DATA)
    up: str = bounded("y", "{y, z}")  # axis of the file that points up: y, as glTF says, or z
    scale: float = bounded(1.0, "(0, inf) m")  # unit of the file
    # [m] Of the distance field; 0: 0.1 m, or more for 20 million voxels.
    voxel_size: float = bounded(0.0, "[0, inf) m")
    # Color of the sky; red, green, blue in 0 to 1.
    background: list[float] = bounded(lambda: [0.6, 0.75, 0.9], "[0, 1]")
    # If true, start and goal are drawn from the seed; otherwise a long route decides.
    draw_ends: bool = False
    # [m] Minimum length of the shortest route between ends that are drawn.
    min_path: float = bounded(SHORTEST, "[0, inf) m")

    def check(self) -> None:
        require_field(self, "path", self.path, "a mesh")
        require_field(self, "background", len(self.background) == 3, "red, green and blue")


def _above_surfaces(esdf: Esdf) -> Esdf:
    """Makes free space without a surface below, as under terrain, unknown, unless all is."""
    free = esdf.states == FieldState.FREE
    above = np.logical_or.accumulate(esdf.states == FieldState.OCCUPIED, axis=2)
    if not (free & above).any():
        return esdf
    unknown = np.uint8(FieldState.UNKNOWN)
    return replace(esdf, states=np.where(free & ~above, unknown, esdf.states))


def mesh_world(config: MeshWorld, seed: int) -> World:
    """Reads the mesh of `config`."""
    # Trimesh takes a third of the time of all imports of a flight.
    from splatpilot.diagrams.worlds.mesh import check_mesh, mesh_distance, sample_colors
    from splatpilot.diagrams.worlds.mesh_renderer import MeshScene, shade

    path = find_data(Path(config.path), "a mesh")
    check_mesh(path)
    esdf = mesh_distance(path, config.up, config.voxel_size, config.scale)
    drawn = {"min_length": config.min_path, "seed": seed} if config.draw_ends else {}
    ends = choose_ends(_above_surfaces(esdf), config.path, **drawn)
    points, normals, colors, area = sample_colors(path, config.up, config.scale, _PREVIEW)
    extent = np.full((len(points), 2), _GAP * COVERAGE * np.sqrt(area / len(points)))
    surfels = Surfels(points, normals, perpendicular(normals), extent)
    gaussians = to_gaussians(surfels, shade(colors, normals), 0.99)
    sky = tuple(config.background)
    scene = MeshScene(path, config.up, sky, config.scale)
    return World(path.stem, gaussians, esdf, esdf, sky, *ends, rendered=scene)
