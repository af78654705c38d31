"""Scene folders: a reconstructed place on disk.

`gaussians.ply` is what cameras see, `esdf.npz` what collides, and `scene.yaml` (`SceneMetadata`)
where it comes from and how it is to be used. `environment.png`, if there is one, has the colours
of what lies infinitely far (`EnvironmentMap`). `frontier.ply`, if there is one, closes the place
where nobody looked any further: cameras of flights see it too, measures of the scene do not.
"""

import functools
import logging
import math
import os
import shutil
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pydrake.common.yaml import yaml_dump_typed, yaml_load_typed
from pydrake.math import RigidTransform

from splatpilot.diagrams.worlds.feasibility import (
    SHORTEST,
    choose_start_and_goal,
    draw_start_and_goal,
    short_route_warning,
)
from splatpilot.diagrams.worlds.solids.surfaces import Surfels, to_gaussians
from splatpilot.diagrams.worlds.splits import check_split
from splatpilot.diagrams.worlds.world import World
from splatpilot.systems.collision.distance_field import FieldState
from splatpilot.systems.collision.esdf import Esdf
from splatpilot.systems.collision.esdf_build import (
    bounds_of_depth_images,
    esdf_from_depth_images,
    esdf_from_gaussians,
)
from splatpilot.systems.collision.frontier import (
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
from splatpilot.systems.common.readers import read_text, reason_of, yaml_errors
from splatpilot.systems.splats.background import FAR, Background, EnvironmentMap, mean_color
from splatpilot.systems.splats.scene import GaussianScene
from splatpilot.systems.splats.splat_files import read_ply, read_splats, write_ply
from splatpilot.systems.vehicle.quadrotor import VEHICLE_RADIUS

FORMAT_VERSION = 2
CAPTURE = "capture"  # folder of a capture that was rendered for the scene
ENVIRONMENT = "environment.png"
FRONTIER = "frontier.ply"
WORLD_FRAME = "z up"
REPRESENTATIONS = ("3dgs", "2dgs")


@dataclass(kw_only=True)
class SceneMetadata:
    """The content of `scene.yaml`. Fields that a file lacks have the defaults given here, except
    for the vectors, which it must give."""

    format_version: int = FORMAT_VERSION
    name: str = ""
    provenance: str = ""
    """What the scene was made from, and how."""
    split: str = ""
    """What the scene is for: "train", "validation" or "test"; empty if unknown."""
    source_digest: list[str] = field(default_factory=list)
    """Digest of what the scene was made from, see `splits.source_digest`: of the images that it was
    fitted to, or of the mesh or generated world that they were rendered of. Empty if unknown."""
    world_frame: str = WORLD_FRAME
    metric: bool = True
    """Whether the unit of length is the metre."""
    origin: list[float] = field(default_factory=lambda: [0.0, 0.0, 0.0])
    """[m], position of the scene's origin in the world of the capture's files, upright and in
    meters; all positions of the scene are relative to it."""
    lower_W: list[float] = field(default_factory=list)
    """[m], lower corner of the distance field."""
    upper_W: list[float] = field(default_factory=list)
    """[m], upper corner of the distance field."""
    observed_free_volume: float = 0.0
    """[m^3], space seen to be free."""
    gains: list[float] = field(default_factory=list)
    """Brightness of each image of the capture relative to the scene, in frame order."""
    vignetting: float = 0.0
    """Logarithm of the brightness of the capture's image corners relative to their centres; it
    falls with the square of the distance from the centre. The scene is free of it."""
    background: list[float] = field(default_factory=lambda: [0.0, 0.0, 0.0])
    """Colour where no Gaussian is seen; red, green, blue in 0 to 1."""
    environment: bool = False
    """Whether `environment.png` has that colour for each direction; `background` is their mean."""
    frontier: bool = False
    """Whether `frontier.ply` stands where the distance field has obstacles that nobody saw."""
    p_WS: list[float] = field(default_factory=list)
    """[m], default start."""
    p_WG: list[float] = field(default_factory=list)
    """[m], default goal."""
    representation: str = "3dgs"
    """"3dgs": Gaussians; "2dgs": surfels, kept as Gaussians that are as flat as allowed."""
    capture: str = ""
    """Folder of the capture that the scene was made from; empty if unknown."""
    capture_settings: list[str] = field(default_factory=list)
    """What was set about the capture when it was read, "depth_unit=5000.0" for example; without it
    the folder would be read otherwise."""
    capture_notes: list[str] = field(default_factory=list)
    """What was assumed or not used when the capture was read, and where intrinsics come from."""
    held_out: list[int] = field(default_factory=list)
    """Frames of the capture that had no part in making the scene."""
    image_width: int = 0
    """[px], to which images were scaled down for the making; 0 if they were not."""
    perturbation_bound: float | None = None
    """[m], how far from the poses of the capture images of the scene can be trusted, as
    `splatpilot fidelity` measured it; None before."""
    pose_perturbation_bounds: list[float] = field(default_factory=list)
    """[m], the same for each pose of the capture, in frame order; empty before."""


def read_scene_metadata(path: str | Path) -> SceneMetadata:
    """Reads `scene.yaml` of the scene folder `path`.

    Raises:
        ValueError: for unknown or missing fields, values of the wrong kind, vectors that have not
            three finite components and a format version that is not known.
    """
    file = Path(path) / "scene.yaml"
    text = read_text(file)
    try:
        with yaml_errors("the text"):
            metadata = yaml_load_typed(schema=SceneMetadata, data=text)
    except Exception as error:  # Drake's reader raises any type.
        remedy = "reconstruct the scene again or repair it"
        raise ValueError(f"{file}: {reason_of(error)}; {remedy}") from None
    if metadata.format_version < FORMAT_VERSION:
        raise ValueError(
            f"{file}: format version {metadata.format_version}, from when scenes had no background "
            "of their own and translucent surfaces; reconstruct the scene again"
        )
    if metadata.format_version > FORMAT_VERSION:
        raise ValueError(
            f"{file}: format version {metadata.format_version}, this program knows "
            f"{FORMAT_VERSION}; use the version of the program that wrote the scene"
        )
    for name in ("origin", "lower_W", "upper_W", "background", "p_WS", "p_WG"):
        value = getattr(metadata, name)
        if len(value) != 3 or not np.isfinite(value).all():
            raise ValueError(f"{file}: {name} is {value}, three finite numbers are needed")
    if metadata.world_frame != WORLD_FRAME:
        raise ValueError(
            f"{file}: world_frame is {metadata.world_frame!r}, it must be {WORLD_FRAME!r}; "
            "turn the scene and reconstruct it again"
        )
    if not all(0 <= value <= 1 for value in metadata.background):
        raise ValueError(f"{file}: background is {metadata.background}, 0 to 1 is needed")
    if metadata.representation not in REPRESENTATIONS:
        raise ValueError(
            f"{file}: representation is {metadata.representation!r}, it must be one of "
            f"{REPRESENTATIONS}"
        )
    if metadata.image_width < 0 or any(frame < 0 for frame in metadata.held_out):
        raise ValueError(
            f"{file}: image_width is {metadata.image_width} and held_out {metadata.held_out}; "
            "neither may be negative"
        )
    try:
        check_split(metadata.split)
    except ValueError as error:
        raise ValueError(f"{file}: {error}") from None
    bounds = np.array([metadata.perturbation_bound or 0.0, *metadata.pose_perturbation_bounds])
    if not (np.isfinite(bounds) & (bounds >= 0)).all():
        raise ValueError(
            f"{file}: perturbation_bound is {metadata.perturbation_bound} and "
            f"pose_perturbation_bounds {metadata.pose_perturbation_bounds}; finite lengths [m] of "
            "at least 0 are needed, run `splatpilot fidelity` again"
        )
    return metadata


def write_scene_metadata(path: str | Path, metadata: SceneMetadata) -> None:
    """Replaces `scene.yaml` of the scene folder `path`, whole or not at all.

    Raises:
        OSError: if it cannot be written.
    """
    with written_atomically(Path(path) / "scene.yaml") as partial:
        yaml_dump_typed(metadata, filename=str(partial))


_log = logging.getLogger(__name__)
_MAX_VOXELS = 2e7
_COARSEST = 0.25  # [m], voxels at which a vehicle of 0.354 m radius still finds its way


def read_scene(path: str | Path) -> World:
    """Reads a scene folder, or a file of Gaussians alone, see `read_splats`.

    Raises:
        FileNotFoundError, ValueError: if there is no scene at `path`, or a damaged one.
    """
    path = Path(path)
    return read_scene_folder(path) if path.is_dir() else _read_bare_gaussians(path)


def read_scene_folder(path: str | Path, *, metric: bool = True) -> World:
    """Reads a scene folder; with `metric` false also one whose unit of length is unknown, to be
    looked at and measured, not flown in.

    Raises:
        FileNotFoundError: if the folder or one of its files is missing.
        ValueError: if a file is damaged, has an unknown field, or the scene is not metric.
    """
    path = Path(path)
    for file in (path, path / "scene.yaml", path / "gaussians.ply", path / "esdf.npz"):
        if not file.exists():
            raise FileNotFoundError(
                f"{file}: does not exist; a scene is a folder with gaussians.ply, esdf.npz and "
                "scene.yaml, as `splatpilot reconstruct` writes it"
            )
    metadata = read_scene_metadata(path)
    if metric and not metadata.metric:
        raise ValueError(
            f"{path / 'scene.yaml'}: the scale of this scene is unknown (metric: false), so no "
            f"distance in it can be trusted; measure something in `splatpilot view {path}` and "
            "give the scene its size with `splatpilot scale`"
        )
    gaussians = read_ply(path / "gaussians.ply")
    if metadata.frontier:
        gaussians = gaussians.merged_with(read_ply(path / FRONTIER))
    esdf = Esdf.load(path / "esdf.npz")
    for name in ("lower_W", "upper_W"):
        said, found = getattr(metadata, name), getattr(esdf, name)
        if not np.allclose(said, found, atol=1e-6):
            raise ValueError(
                f"{path}: scene.yaml has {name} {said}, but esdf.npz has {found.tolist()}; "
                "the files are of different scenes"
            )
    return World(
        name=metadata.name,
        gaussians=gaussians,
        distance_field=esdf,
        esdf=esdf,
        background=read_background(path, metadata),
        p_WS=np.array(metadata.p_WS),
        p_WG=np.array(metadata.p_WG),
    )


def read_background(path: Path, metadata: SceneMetadata) -> Background:
    """Returns the background of the scene folder `path`, whose `scene.yaml` says `metadata`.

    Raises:
        FileNotFoundError, ValueError: if `environment.png` is missing or damaged.
    """
    if metadata.environment:
        return EnvironmentMap.load(path / ENVIRONMENT)
    red, green, blue = metadata.background
    return red, green, blue


def check_scene_target(path: str | Path) -> None:
    """Checks that a scene may be written to `path`: nothing there, an empty folder, a scene, or the
    capture that it is made of, in `CAPTURE`.

    Raises:
        ValueError: if something else is there.
        OSError: if the folder in which it would stand cannot be made or written to.
    """
    path = Path(path).absolute()
    if path.exists() and not (path / "scene.yaml").is_file():
        own = {CAPTURE, f".{CAPTURE}.partial"}
        if not path.is_dir() or {entry.name for entry in path.iterdir()} - own:
            raise ValueError(
                f"{path}: exists and is no scene, so it is not overwritten; choose another folder"
            )
    parent = next(parent for parent in path.parents if parent.exists())
    if not parent.is_dir():
        raise NotADirectoryError(f"{parent}: is a file, so {path} cannot stand in it")
    require_writable_folder(parent)


def write_scene_folder(
    path: str | Path,
    world: World,
    frontier: GaussianScene | None = None,
    *,
    provenance: str,
    gains: Sequence[float] = (),
    vignetting: float = 0.0,
    metric: bool = True,
    representation: str = "3dgs",
    capture: str = "",
    capture_settings: Sequence[str] = (),
    capture_notes: Sequence[str] = (),
    origin: Sequence[float] | NDArray[np.float64] = (0.0, 0.0, 0.0),
    held_out: Sequence[int] = (),
    image_width: int = 0,
    split: str = "",
    source_digest: Sequence[str] = (),
) -> SceneMetadata:
    """Writes `world` as a scene folder and returns what its `scene.yaml` says; see `SceneMetadata`
    for what is said about it. Its Gaussians are without the `frontier`, see `close_frontier`.

    The folder appears whole: it is written beside its place and renamed. A scene that stands there
    is replaced in the same step. Only the grid of the distance field is kept.

    Raises:
        ValueError, OSError: see `check_scene_target`; or if the disk is full.
    """
    path = Path(path).absolute()
    check_scene_target(path)
    esdf = world.esdf
    metadata = SceneMetadata(
        name=world.name,
        provenance=provenance,
        split=split,
        source_digest=list(source_digest),
        metric=metric,
        lower_W=[float(x) for x in esdf.lower_W],
        upper_W=[float(x) for x in esdf.upper_W],
        observed_free_volume=esdf.volume(FieldState.FREE),
        gains=[float(gain) for gain in gains],
        vignetting=float(vignetting),
        background=[float(x) for x in mean_color(world.background)],
        environment=isinstance(world.background, EnvironmentMap),
        p_WS=[float(x) for x in world.p_WS],
        p_WG=[float(x) for x in world.p_WG],
        frontier=frontier is not None,
        representation=representation,
        capture=capture,
        capture_settings=list(capture_settings),
        capture_notes=list(capture_notes),
        origin=[float(x) for x in origin],
        held_out=[int(frame) for frame in held_out],
        image_width=image_width,
    )
    with folder_written_atomically(path, replace=True) as new:
        write_ply(world.gaussians, new / "gaussians.ply")
        if frontier is not None:
            write_ply(frontier, new / FRONTIER)
        esdf.save(new / "esdf.npz")
        if isinstance(world.background, EnvironmentMap):
            world.background.save(new / ENVIRONMENT)
        if (path / CAPTURE).is_dir():
            shutil.copytree(path / CAPTURE, new / CAPTURE, copy_function=os.link)
        write_scene_metadata(new, metadata)
    return metadata


def _read_bare_gaussians(path: Path) -> World:
    """Builds a world from Gaussians alone: every place that no Gaussian fills counts as free."""
    gaussians = read_splats(path)
    # A few stray Gaussians far away must not stretch the grid; beyond it all counts as occupied.
    lower_W, upper_W = np.percentile(gaussians.means.astype(float), [1, 99], axis=0)
    lower_W, upper_W = lower_W - 0.1, upper_W + 0.1
    voxel_size = max(0.1, float(np.cbrt(np.prod(upper_W - lower_W) / _MAX_VOXELS)))
    if voxel_size > _COARSEST:
        raise ValueError(
            f"{path}: 98 % of the Gaussians span {np.round(upper_W - lower_W, 1).tolist()} m, for "
            f"which voxels of {voxel_size:.2f} m would be needed, more than {_COARSEST} m; crop "
            "far Gaussians away, or give it its size with `splatpilot scale`"
        )
    esdf = esdf_from_gaussians(gaussians, voxel_size, lower_W, upper_W)
    p_WS, p_WG, length = choose_start_and_goal(esdf, VEHICLE_RADIUS)
    if warning := short_route_warning(length):
        _log.warning("%s: %s", path, warning)
    return World(
        name=path.stem,
        gaussians=gaussians,
        distance_field=esdf,
        esdf=esdf,
        background=(0.0, 0.0, 0.0),
        p_WS=p_WS,
        p_WG=p_WG,
    )


@dataclass
class SceneSource:
    """A place on disk."""

    # A scene folder, or a file of Gaussians (PLY, SPZ or .splat); one that is not there is looked
    # for in the folder that the environment variable SPLATPILOT_SCENES names, or in `scenes`.
    path: str = ""
    # How to get the scene: what the error says if it is not there.
    source: str = ""
    # Whether start and goal are drawn from the seed; otherwise they are the scene's own.
    draw_ends: bool = False
    # [m] Least length of the shortest way between ends that are drawn.
    least_way: float = SHORTEST

    def validate(self) -> None:
        """
        Raises:
            ValueError: if no path is given, or the least way is negative or infinite.
        """
        if not self.path:
            raise ValueError("world.path is empty; name a scene folder or a file of Gaussians")
        if not 0 <= self.least_way < math.inf:
            raise ValueError(
                f"world.least_way is {self.least_way} m; it must be finite and at least 0"
            )


@dataclass
class SceneConfig(SceneSource):
    """A scene on disk. It is no base of others, for the reason that `ForestConfig` gives."""


def find_scene(config: SceneSource) -> Path:
    """The place of a scene.

    Raises:
        FileNotFoundError: if it is in none of the places where scenes are looked for; the message
            says how to get it.
    """
    config.validate()
    return require_scene(config.path, config.source)


def read_scene_world(config: SceneSource, seed: int) -> World:
    """Reads the scene of `config`.

    Raises:
        FileNotFoundError, ValueError: see `find_scene` and `read_scene`.
        InfeasibleFlightError: see `draw_start_and_goal`.
    """
    world = read_scene(find_scene(config))
    if not config.draw_ends:
        return world
    p_WS, p_WG, _ = draw_start_and_goal(world.esdf, VEHICLE_RADIUS, seed, least=config.least_way)
    return replace(world, p_WS=p_WS, p_WG=p_WG)


_CELL = 2
"""[-] Voxels along the edge of the cells whose faces one surfel covers."""

_SUNK = 0.5
"""[-] Voxels from the faces into what is hidden, so that no edge of a surfel hangs out of it."""

_COVERAGE = 0.55
"""Standard deviation of a surfel over the edge of its square. Less than in generated worlds, whose
patches may hang over edges a little more: here that would hide what was captured."""

_WIDTH = 160
"""[px], about as wide depth images are thinned to."""

_FAR_VOXEL, _FAR_VOXELS = 2, 2e6
"""[-] Edge of the voxels in which the frontier beyond the field's range is found, in voxels of the
field, and how many there may be."""

_STRIPE = 0.4
"""[m], period of the hatching along each axis."""

_SHADES = np.array([0.62, 0.42])
"""Grey of its two tones, 0 to 1."""


def close_frontier(
    esdf: Esdf, depths: Iterable[np.ndarray], K: np.ndarray, X_WCs: Sequence[RigidTransform]
) -> tuple[Esdf, GaussianScene | None]:
    """Closes a captured scene where space that the vehicle can look into ends in unknown space.

    Without it nothing would be seen there, and flights would end all the same. What nobody looked
    into begins with obstacles, and hatched surfels are drawn on them. Space before the sky, and
    before what was captured beyond the field's range, stays open. There the surfels begin where
    the images saw no farther, on a coarse grid of its own: none hides what was captured.

    Args:
        esdf: the distance field of the scene.
        depths, K, X_WCs: what it was made of, see `esdf_from_depth_images`.

    Returns:
        The distance field with these obstacles, and the surfels; `esdf` and None where there is
        nothing to close.
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
    if beyond:
        parts.append(_far_frontier(_FAR_VOXEL * esdf.voxel_size, *views))
    if not parts:
        return esdf, None
    return with_obstacles(esdf, hidden), functools.reduce(GaussianScene.merged_with, parts)


def _far_frontier(
    voxel_size: float, images: Sequence[np.ndarray], K: np.ndarray, X_WCs: Sequence[RigidTransform]
) -> GaussianScene:
    """Draws the frontier of all that images show, on a grid of at least `voxel_size` [m]."""
    reach = 2.0 * max(float(image[image < FAR].max(initial=0.0)) for image in images)  # [m]
    lower_W, upper_W = bounds_of_depth_images(images, K, X_WCs, reach)
    voxel_size = max(voxel_size, float(np.cbrt(np.prod(upper_W - lower_W) / _FAR_VOXELS)))
    far = esdf_from_depth_images(images, K, X_WCs, lower_W, upper_W, voxel_size, reach)
    reachable = reachable_space(far, VEHICLE_RADIUS)
    hidden, before, _ = hidden_frontier(far, reachable, images, K, X_WCs)
    return _draw(far, *frontier_faces(before, hidden))


def _draw(esdf: Esdf, centers: NDArray[np.float64], normals: NDArray[np.float64]) -> GaussianScene:
    """Faces of voxels (F, 3), (F, 3), see `frontier_faces`, as surfels: one for those in each cell,
    of their mean and their spread, so that it lies across the steps of a slanted frontier."""
    _, cell = np.unique((centers // _CELL).astype(int), axis=0, return_inverse=True)
    count = np.bincount(cell)

    def mean(values: NDArray) -> NDArray[np.float64]:
        return np.bincount(cell, values) / count

    middle, normal = (np.stack([mean(x) for x in v.T], axis=-1) for v in (centers, normals))
    offset = centers - middle[cell]
    covariance = np.empty((len(count), 3, 3))
    for i in range(3):
        for j in range(3):
            covariance[:, i, j] = mean(offset[:, i] * offset[:, j])
        covariance[:, i, i] += mean(normals[:, i] == 0.0) / 12.0  # of faces along axis i
    variance, R_WP = np.linalg.eigh(covariance)  # ascending
    p = esdf.lower_W + esdf.voxel_size * (middle - _SUNK * normal)
    # A square of edge a has the deviation a / sqrt(12); a surfel of _COVERAGE a covers it.
    extent = _COVERAGE * np.sqrt(12.0 * variance[:, [2, 1]]) * esdf.voxel_size
    surfels = Surfels(p, R_WP[:, :, 0], R_WP[:, :, 2], extent)
    shade = _SHADES[np.floor(2.0 * p.sum(axis=1) / _STRIPE).astype(int) % 2]
    return to_gaussians(surfels, np.repeat(shade[:, None], 3, axis=1), 0.99)
