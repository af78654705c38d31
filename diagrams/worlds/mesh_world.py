"""Worlds from meshes."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from splatpilot.diagrams.worlds.feasibility import SHORTEST, choose_ends
from splatpilot.diagrams.worlds.solids.surfaces import (
    COVERAGE,
    Surfels,
    perpendicular,
    to_gaussians,
)
from splatpilot.diagrams.worlds.world import World
from splatpilot.systems.common.files import find_data
from splatpilot.systems.common.validation import Config, bounded, require_field

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


def mesh_world(config: MeshWorld, seed: int) -> World:
    """Reads the mesh of `config`."""
    # Trimesh takes a third of the time of all imports of a flight.
    from splatpilot.diagrams.worlds.mesh import check_mesh, mesh_distance, sample_colors
    from splatpilot.diagrams.worlds.mesh_renderer import MeshScene, shade

    config.validate()
    path = find_data(Path(config.path), "a mesh")
    check_mesh(path, config.up)
    esdf = mesh_distance(path, config.up, config.voxel_size, config.scale)
    drawn = {"min_length": config.min_path, "seed": seed} if config.draw_ends else {}
    ends = choose_ends(esdf, config.path, **drawn)
    points, normals, colors, area = sample_colors(path, config.up, config.scale, _PREVIEW)
    extent = np.full((len(points), 2), _GAP * COVERAGE * np.sqrt(area / len(points)))
    surfels = Surfels(points, normals, perpendicular(normals), extent)
    gaussians = to_gaussians(surfels, shade(colors, normals), 0.99)
    sky = tuple(config.background)
    scene = MeshScene(path, config.up, sky, config.scale)
    return World(path.stem, gaussians, esdf, esdf, sky, *ends, rendered=scene)
