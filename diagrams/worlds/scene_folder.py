"""Scene folders: a reconstructed environment on disk.

`gaussians.ply`, or packed `gaussians.spz`, is for cameras, `esdf.npz` for collisions, and
`scene.yaml` is `SceneMetadata`. If present, `environment.png` is the background, `frontier.ply`
closes unobserved space for cameras of flights, and `observations.npz` tells how often and from
where images saw each surface.
"""

import functools
import os
import shutil
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydrake.common.yaml import yaml_dump_typed, yaml_load_typed
from pydrake.math import RigidTransform

from splatpilot.diagrams.worlds.building_blocks import suitable_voxel
from splatpilot.diagrams.worlds.feasibility import SHORTEST, choose_ends
from splatpilot.diagrams.worlds.observed_routes import MAX_UNOBSERVED, choose_observed_route
from splatpilot.diagrams.worlds.solids.surfaces import Surfels, to_gaussians
from splatpilot.diagrams.worlds.splits import check_split
from splatpilot.diagrams.worlds.world import World
from splatpilot.systems.collision.depth_fusion import bounds_of_depth_images, esdf_from_depth_images
from splatpilot.systems.collision.distance_field import FieldState
from splatpilot.systems.collision.esdf import Esdf
from splatpilot.systems.collision.esdf_build import esdf_from_gaussians
from splatpilot.systems.collision.observations import (
    Observations,
    frontier_faces,
    hidden_frontier,
    reachable_space,
    with_obstacles,
)
from splatpilot.systems.common.files import (
    folder_written_atomically,
    require_scene,
    require_writable_folder,
    written_atomically,
)
from splatpilot.systems.common.readers import error_summary, read_text, yaml_errors
from splatpilot.systems.common.validation import Config, bounded, require, require_field
from splatpilot.systems.splats.background import FAR, Background, EnvironmentMap, mean_color
from splatpilot.systems.splats.scene import GaussianScene, color_to_sh
from splatpilot.systems.splats.splat_files import read_ply, read_splats, sog_meta, write_ply
from splatpilot.systems.vehicle.quadrotor import VEHICLE_RADIUS

FORMAT_VERSION = 2
CAPTURE = "capture"  # folder of a capture that was rendered for the scene
GAUSSIANS = "gaussians.ply"
PACKED_GAUSSIANS = "gaussians.spz"
ESDF = "esdf.npz"
ENVIRONMENT = "environment.png"
FRONTIER = "frontier.ply"
OBSERVATIONS = "observations.npz"
REPRESENTATIONS = "3dgs", "2dgs"
WORLD_FRAME = "z up"


@dataclass(kw_only=True)
class SceneMetadata(Config):
    """The content of `scene.yaml`. Missing fields have defaults, except for the vectors."""

    format_version: int = FORMAT_VERSION
    name: str = ""
    # Description of the source and the method.
    provenance: str = ""
    # "train", "validation" or "test"; empty if unknown.
    split: str = ""
    # Digest of the images, or of the mesh or world that they show, see `splits.source_digest`.
    source_digest: list[str] = field(default_factory=list)
    world_frame: str = bounded(WORLD_FRAME, f"{{{WORLD_FRAME}}}")
    # True if the unit of length is the meter.
    metric: bool = True
    # [m], position of the scene's origin in the world of the capture's files, upright.
    origin: list[float] = bounded(lambda: [0.0] * 3, "(-inf, inf) m")
    lower_W: list[float] = bounded(list, "(-inf, inf) m")  # [m], corners of the distance field
    upper_W: list[float] = bounded(list, "(-inf, inf) m")
    observed_free_volume: float = 0.0  # [m^3]
    # Brightness of each image of the capture relative to the scene, in frame order.
    gains: list[float] = field(default_factory=list)
    # Logarithm of the brightness of the capture's image corners relative to their centers.
    vignetting: float = 0.0
    # Color of pixels without Gaussians: red, green, blue.
    background: list[float] = bounded(lambda: [0.0] * 3, "[0, 1]")
    # True if `environment.png` has that color for each direction; `background` is its mean.
    environment: bool = False
    # True if `frontier.ply` draws the obstacles of the distance field at unobserved space.
    frontier: bool = False
    p_WS: list[float] = bounded(list, "(-inf, inf) m")  # [m], default start
    p_WG: list[float] = bounded(list, "(-inf, inf) m")  # [m], default goal
    # "3dgs": Gaussians; "2dgs": surfels, kept as Gaussians that are as flat as allowed.
    representation: str = bounded("3dgs", f"{{{', '.join(REPRESENTATIONS)}}}")
    # Folder of the capture that the scene was made from; empty if unknown.
    capture: str = ""
    capture_settings: list[str] = field(default_factory=list)  # such as "depth_unit=5000.0"
    capture_notes: list[str] = field(default_factory=list)  # assumptions of the reader
    # Frames of the capture that were not used to make the scene.
    held_out: list[int] = bounded(list, "[0, inf)")
    # [px], to which images were scaled down; 0 if they were not.
    image_width: int = bounded(0, "[0, inf) px")
    # [m], distance from the poses of the capture up to which images of the scene can be trusted;
    # None before `splatpilot scene fidelity`.
    perturbation_bound: float | None = bounded(None, "[0, inf) m")
    # [m], the same for each pose of the capture, in frame order; empty before.
    pose_perturbation_bounds: list[float] = bounded(list, "[0, inf) m")

    def check(self) -> None:
        for name in ("origin", "lower_W", "upper_W", "background", "p_WS", "p_WG"):
            require_field(self, name, len(getattr(self, name)) == 3, "three finite numbers")
        check_split(self.split)


def read_scene_metadata(path: str | Path) -> SceneMetadata:
    """Reads `scene.yaml` of the scene folder `path`."""
    file = Path(path) / "scene.yaml"
    text = read_text(file)
    try:
        with yaml_errors("the text"):
            metadata = yaml_load_typed(schema=SceneMetadata, data=text)
        version, known = metadata.format_version, FORMAT_VERSION
        remedies = "reconstruct the scene again", "use a newer version of the program"
        remedy = remedies[version > known]
        require(version == known, "format_version", str(known), version, remedy)
        metadata.validate()
    except Exception as error:  # Drake's reader raises any type.
        raise ValueError(f"{file}: {error_summary(error)}") from None
    return metadata


def write_scene_metadata(path: str | Path, metadata: SceneMetadata) -> None:
    """Replaces `scene.yaml` of the scene folder `path` atomically."""
    with written_atomically(Path(path) / "scene.yaml") as partial:
        yaml_dump_typed(metadata, filename=str(partial))


def gaussians_file(scene: Path) -> Path:
    """Returns the file with the Gaussians of a scene folder, without its frontier."""
    packed = scene / PACKED_GAUSSIANS
    return packed if packed.exists() else scene / GAUSSIANS


def read_gaussians(scene: Path) -> GaussianScene:
    """Reads the Gaussians of a scene folder, without its frontier."""
    file = gaussians_file(scene)
    return read_ply(file) if file.name == GAUSSIANS else read_splats(file)


_MAX_VOXEL = 0.25  # [m], at which a vehicle of 0.354 m radius still finds a route


def read_scene(path: str | Path, hatched: bool = False) -> World:
    """Reads a scene folder, or a file of Gaussians (see `read_splats`), where space without
    Gaussians counts as free."""
    path = Path(path)
    if path.is_dir() and sog_meta(path) is None:
        return read_scene_folder(path, hatched=hatched)
    gaussians = read_splats(path)
    # Outliers must not stretch the grid; beyond it all counts as occupied.
    lower_W, upper_W = np.percentile(gaussians.means.astype(float), [1, 99], axis=0)
    lower_W, upper_W = lower_W - 0.1, upper_W + 0.1
    voxel_size = suitable_voxel(lower_W, upper_W)
    extent = np.round(upper_W - lower_W, 1).tolist()
    condition = f"small enough for voxels of {_MAX_VOXEL} m"
    remedy = "crop far Gaussians away, or rescale with `splatpilot scene scale`"
    require(voxel_size <= _MAX_VOXEL, f"{path}: extent", condition, f"{extent} m", remedy)
    esdf = esdf_from_gaussians(gaussians, voxel_size, lower_W, upper_W)
    ends = choose_ends(esdf, path)
    return World(path.stem, gaussians, esdf, esdf, (0.0, 0.0, 0.0), *ends)


def read_scene_folder(path: str | Path, *, metric: bool = True, hatched: bool = False) -> World:
    """Reads a scene folder; accepts one without scale unless `metric`. Its frontier is plain and
    dark, or `hatched`."""
    path = Path(path)
    for file in (path, path / "scene.yaml", gaussians_file(path), path / ESDF):
        if not file.exists():
            raise FileNotFoundError(
                f"No such file: {file}; a scene is a folder with gaussians.ply, esdf.npz and "
                "scene.yaml, as written by `splatpilot reconstruct`"
            )
    metadata = read_scene_metadata(path)
    if metric:
        remedy = f"measure a length in `splatpilot view {path}`, then use `splatpilot scene scale`"
        require(metadata.metric, f"{path / 'scene.yaml'}: metric", "true to fly", "false", remedy)
    gaussians = read_gaussians(path)
    num_observed = len(gaussians)
    if metadata.frontier:
        frontier = read_ply(path / FRONTIER)
        stripe = np.floor(2.0 * frontier.means.sum(axis=1) / _STRIPE).astype(int) % 2
        shade = _SHADES[stripe] if hatched else np.full(len(frontier), _PLAIN)
        sh = np.repeat(color_to_sh(shade)[:, None, None], 3, axis=2)
        gaussians = gaussians.merged_with(replace(frontier, sh=sh.astype(np.float32)))
    esdf = Esdf.load(path / ESDF)
    stated = np.array([metadata.lower_W, metadata.upper_W])
    found = np.array([esdf.lower_W, esdf.upper_W])
    what, condition = f"{path / 'scene.yaml'}: lower_W and upper_W", f"those of esdf.npz, {found}"
    valid = np.allclose(stated, found, atol=1e-6)
    require(valid, what, condition, stated, "the files are of different scenes")
    ends, file = np.array([metadata.p_WS, metadata.p_WG]), path / OBSERVATIONS
    observations = Observations.load(file) if file.exists() else None
    further = {"num_frontier": len(gaussians) - num_observed, "observations": observations}
    background = read_background(path, metadata)
    return World(metadata.name, gaussians, esdf, esdf, background, *ends, **further)


def read_background(path: Path, metadata: SceneMetadata) -> Background:
    """Returns the background of the scene folder `path` with this metadata."""
    if metadata.environment:
        return EnvironmentMap.load(path / ENVIRONMENT)
    return tuple(metadata.background)


def check_scene_target(path: str | Path) -> None:
    """Checks that `path` is new, an empty folder, a scene, or a folder with its own `CAPTURE`."""
    path = Path(path).absolute()
    if path.exists() and not (path / "scene.yaml").is_file():
        own = {CAPTURE, f".{CAPTURE}.partial"}
        empty = path.is_dir() and {entry.name for entry in path.iterdir()} <= own
        require(empty, "scene folder", "new, empty or a scene", path, "choose another folder")
    parent = next(parent for parent in path.parents if parent.exists())
    if not parent.is_dir():
        raise NotADirectoryError(f"{parent}: is a file, not a folder for {path.name}")
    require_writable_folder(parent)


def write_scene_folder(
    path: str | Path, world: World, frontier: GaussianScene | None = None, **fields: Any
) -> SceneMetadata:
    """Writes `world` as a scene folder atomically, replacing a scene there; returns its metadata.
    The frontier is that of `close_frontier`; `fields` are further ones of `SceneMetadata`."""
    path = Path(path).absolute()
    check_scene_target(path)
    esdf = world.esdf
    metadata = SceneMetadata(
        name=world.name,
        lower_W=esdf.lower_W.tolist(),
        upper_W=esdf.upper_W.tolist(),
        observed_free_volume=esdf.volume(FieldState.FREE),
        background=[float(x) for x in mean_color(world.background)],
        environment=isinstance(world.background, EnvironmentMap),
        p_WS=np.asarray(world.p_WS, float).tolist(),
        p_WG=np.asarray(world.p_WG, float).tolist(),
        frontier=frontier is not None,
        **{name: np.asarray(value).tolist() for name, value in fields.items()},
    )
    with folder_written_atomically(path, replace=True) as new:
        write_ply(world.gaussians, new / GAUSSIANS)
        if frontier is not None:
            write_ply(frontier, new / FRONTIER)
        esdf.save(new / ESDF)
        if world.observations is not None:
            world.observations.save(new / OBSERVATIONS)
        if isinstance(world.background, EnvironmentMap):
            world.background.save(new / ENVIRONMENT)
        if (path / CAPTURE).is_dir():
            shutil.copytree(path / CAPTURE, new / CAPTURE, copy_function=os.link)
        write_scene_metadata(new, metadata)
    return metadata


@dataclass
class SceneSource(Config):
    """An environment on disk."""

    # A scene folder, or a file of Gaussians (see `read_splats`): here, or in the folder of the
    # environment variable SPLATPILOT_SCENES, by default `scenes`, or in this package.
    path: str = ""
    # How to get the scene, for the error if it is missing.
    source: str = ""
    # If true, start and goal are drawn from the seed; otherwise they are the scene's own.
    draw_ends: bool = False
    # [m] Minimum length of the shortest route between ends that are drawn.
    min_path: float = bounded(SHORTEST, "[0, inf) m")
    # [-] Maximum mean fraction of pixels without an observed surface that a camera sees along the
    # route between ends that are drawn; 1 for any. A scene without observations has no limit.
    max_unobserved: float = bounded(MAX_UNOBSERVED, "[0, 1]")
    # If true, surfaces that close unobserved space are hatched; otherwise they are plain and dark.
    hatched: bool = False

    def check(self) -> None:
        require_field(self, "path", self.path, "a scene folder or a file of Gaussians")


@dataclass
class SceneConfig(SceneSource):
    """A scene on disk. Not a base of others, see `ForestConfig`."""


def find_scene(config: SceneSource) -> Path:
    """Returns the path of a scene."""
    return require_scene(config.path, config.source)


def read_scene_world(config: SceneSource, seed: int) -> World:
    """Reads the scene of `config`."""
    world = read_scene(find_scene(config), config.hatched)
    return draw_ends(config, world, seed) if config.draw_ends else world


def draw_ends(config: SceneSource, world: World, seed: int) -> World:
    """Returns the world with another start and goal, see `SceneSource`."""
    known = world.observations is not None and len(world.observations.view_points)
    limit, length = config.max_unobserved, config.min_path
    if known and limit < 1.0:
        route = choose_observed_route(world, limit, length, seed)
        return replace(world, p_WS=route.p_WS, p_WG=route.p_WG)
    p_WS, p_WG = choose_ends(world.esdf, config.path, length, seed)
    return replace(world, p_WS=p_WS, p_WG=p_WG)


_CELL = 2  # [voxels] edge of the cells whose faces one surfel covers
_SUNK = 0.5  # [voxels] from the faces into hidden space, so that no edge of a surfel sticks out
# Standard deviation of a surfel over the edge of its square; less than in generated worlds, so that
# no surfel hides captured surfaces.
_COVERAGE = 0.55
_WIDTH = 160  # [px] approximate width to which depth images are subsampled
# Edge of the voxels of the frontier beyond the field's range, in voxels of the field, and their
# maximum number.
_FAR_VOXEL, _FAR_VOXELS = 2, 2e6
_STRIPE = 0.4  # [m] period of the hatching along each axis
_SHADES = np.array([0.62, 0.42])  # gray of its two tones, 0 to 1
_PLAIN = 0.1  # gray of a frontier that is not hatched


def close_frontier(
    esdf: Esdf, depths: Iterable[np.ndarray], K: np.ndarray, X_WCs: Sequence[RigidTransform]
) -> tuple[Esdf, GaussianScene | None]:
    """Closes a captured scene where reachable space ends in unknown space.

    Returns the distance field with obstacles where unknown space begins, and surfels that draw
    them; `esdf` and None if the scene is closed. Space before the sky, and before surfaces
    beyond the field's range, has no obstacles; its surfels begin behind all that the images saw.
    """
    images = []
    for depth in depths:
        step = max(depth.shape[1] // _WIDTH, 1)
        images.append(depth[step // 2 :: step, step // 2 :: step])
        if len(images) == 1:
            K = np.diag([1 / step, 1 / step, 1.0]) @ K
    views = images, K, X_WCs
    hidden, before, beyond = hidden_frontier(esdf, reachable_space(esdf, VEHICLE_RADIUS), *views)
    parts = []
    if hidden.any():
        parts.append(_draw(esdf, *frontier_faces(before, hidden)))
    if beyond:  # on a grid of all that images show
        reach = 2.0 * max(float(image[image < FAR].max(initial=0.0)) for image in images)  # [m]
        lower_W, upper_W = bounds_of_depth_images(*views, reach)
        voxel_size = float(np.cbrt(np.prod(upper_W - lower_W) / _FAR_VOXELS))
        voxel_size = max(_FAR_VOXEL * esdf.voxel_size, voxel_size)
        far = esdf_from_depth_images(*views, lower_W, upper_W, voxel_size, reach)
        unseen, before, _ = hidden_frontier(far, reachable_space(far, VEHICLE_RADIUS), *views)
        parts.append(_draw(far, *frontier_faces(before, unseen)))
    if not parts:
        return esdf, None
    return with_obstacles(esdf, hidden), functools.reduce(GaussianScene.merged_with, parts)


def _draw(esdf: Esdf, centers: NDArray[np.float64], normals: NDArray[np.float64]) -> GaussianScene:
    """Draws faces of `frontier_faces` as one surfel per cell, of the same mean and spread."""
    _, cell = np.unique((centers // _CELL).astype(int), axis=0, return_inverse=True)
    count = np.bincount(cell)

    def mean(values: NDArray) -> NDArray[np.float64]:
        return np.bincount(cell, values) / count

    middle, normal = (np.stack([mean(x) for x in v.T], axis=-1) for v in (centers, normals))
    offset = centers - middle[cell]
    covariance = np.empty((len(count), 3, 3))
    for i, j in np.ndindex(3, 3):
        covariance[:, i, j] = mean(offset[:, i] * offset[:, j])
    for i in range(3):
        covariance[:, i, i] += mean(normals[:, i] == 0.0) / 12.0  # of faces along axis i
    variance, R_WP = np.linalg.eigh(covariance)  # ascending
    p = esdf.lower_W + esdf.voxel_size * (middle - _SUNK * normal)
    # A square of edge a has the deviation a / sqrt(12); a surfel of _COVERAGE a covers it.
    extent = _COVERAGE * np.sqrt(12.0 * variance[:, [2, 1]]) * esdf.voxel_size
    surfels = Surfels(p, R_WP[:, :, 0], R_WP[:, :, 2], extent)
    return to_gaussians(surfels, np.full((len(p), 3), _PLAIN), 0.99)
