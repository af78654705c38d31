"""Scene folders: a reconstructed place on disk.

`gaussians.ply` is what cameras see, `esdf.npz` what collides, and `scene.yaml` (`SceneMetadata`)
where it comes from and how it is to be used. `environment.png`, if there is one, has the colours
of what lies infinitely far (`EnvironmentMap`). `frontier.ply`, if there is one, closes the place
where nobody looked any further: cameras of flights see it too, measures of the scene do not.
"""

import logging
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from splatpilot.diagrams.worlds.scene_metadata import (
    ENVIRONMENT,
    FRONTIER,
    SceneMetadata,
    read_scene_metadata,
    write_scene_metadata,
)
from splatpilot.diagrams.worlds.start_and_goal import choose_start_and_goal, short_route_warning
from splatpilot.diagrams.worlds.world import World
from splatpilot.systems.collision.distance_field import FieldState
from splatpilot.systems.collision.esdf import Esdf
from splatpilot.systems.collision.esdf_build import esdf_from_gaussians
from splatpilot.systems.files import folder_written_atomically, require_writable_folder
from splatpilot.systems.splats.background import Background, EnvironmentMap, mean_color
from splatpilot.systems.splats.gaussian_ply import read_ply, write_ply
from splatpilot.systems.splats.gaussian_scene import GaussianScene
from splatpilot.systems.splats.splat_files import read_splats
from splatpilot.systems.vehicle.quadrotor_dynamics import VEHICLE_RADIUS

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
    """Checks that a scene may be written to `path`: nothing there, an empty folder, or a scene.

    Raises:
        ValueError: if something else is there.
        OSError: if the folder in which it would stand cannot be made or written to.
    """
    path = Path(path).absolute()
    if path.exists() and not (path / "scene.yaml").is_file():
        if not path.is_dir() or any(path.iterdir()):
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
