"""Scene folders: a reconstructed place on disk.

`gaussians.ply` is what cameras see, `esdf.npz` what collides, and `scene.yaml` (`SceneMetadata`)
where it comes from and how it is to be used.
"""

import os
import shutil
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import yaml
from pydrake.common.yaml import yaml_dump_typed, yaml_load_typed

from splatpilot.diagrams.worlds.start_and_goal import choose_start_and_goal
from splatpilot.diagrams.worlds.world import World
from splatpilot.systems.collision.distance_field import FieldState
from splatpilot.systems.collision.esdf import Esdf
from splatpilot.systems.collision.esdf_build import esdf_from_gaussians
from splatpilot.systems.files import require_writable_folder, written_atomically
from splatpilot.systems.splats.gaussian_ply import read_ply, write_ply
from splatpilot.systems.vehicle.quadrotor_dynamics import VEHICLE_RADIUS

FORMAT_VERSION = 1
WORLD_FRAME = "z up"
REPRESENTATIONS = ("3dgs", "2dgs")

_MAX_VOXELS = 2e7
_COARSEST = 0.25  # [m], voxels at which a vehicle of 0.354 m radius still finds its way


@dataclass(kw_only=True)
class SceneMetadata:
    """The content of `scene.yaml`. Fields that a file lacks have the defaults given here, except
    for the vectors, which it must give."""

    format_version: int = FORMAT_VERSION
    name: str = ""
    provenance: str = ""
    """What the scene was made from, and how."""
    world_frame: str = WORLD_FRAME
    metric: bool = True
    """Whether the unit of length is the metre."""
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
    p_WS: list[float] = field(default_factory=list)
    """[m], default start."""
    p_WG: list[float] = field(default_factory=list)
    """[m], default goal."""
    representation: str = "3dgs"
    """"3dgs": Gaussians; "2dgs": surfels, kept as Gaussians that are as flat as allowed."""
    capture: str = ""
    """Folder of the capture that the scene was made from; empty if unknown."""
    held_out: list[int] = field(default_factory=list)
    """Frames of the capture that had no part in making the scene."""
    image_width: int = 0
    """[px], to which images were scaled down for the making; 0 if they were not."""
    perturbation_bound: float | None = None
    """[m], how far from the poses of the capture images of the scene can be trusted, as
    `splatpilot fidelity` measured it; None before."""
    pose_perturbation_bounds: list[float] = field(default_factory=list)
    """[m], the same for each pose of the capture, in frame order; empty before."""


def read_scene(path: str | Path) -> World:
    """Reads a scene folder, or a PLY file of Gaussians alone.

    Raises:
        FileNotFoundError, ValueError: if there is no scene at `path`, or a damaged one.
    """
    path = Path(path)
    return read_scene_folder(path) if path.is_dir() else _read_bare_ply(path)


def read_scene_folder(path: str | Path) -> World:
    """Reads a scene folder.

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
    if not metadata.metric:
        raise ValueError(
            f"{path / 'scene.yaml'}: the scale of this scene is unknown (metric: false), so no "
            "distance in it can be trusted; reconstruct it with a scale"
        )
    esdf = Esdf.load(path / "esdf.npz")
    for name in ("lower_W", "upper_W"):
        said, found = getattr(metadata, name), getattr(esdf, name)
        if not np.allclose(said, found, atol=1e-6):
            raise ValueError(
                f"{path}: scene.yaml has {name} {said}, but esdf.npz has {found.tolist()}; "
                "the files are of different scenes"
            )
    red, green, blue = metadata.background
    return World(
        name=metadata.name,
        gaussians=read_ply(path / "gaussians.ply"),
        distance_field=esdf,
        esdf=esdf,
        background=(red, green, blue),
        p_WS=np.array(metadata.p_WS),
        p_WG=np.array(metadata.p_WG),
    )


def read_scene_metadata(path: str | Path) -> SceneMetadata:
    """Reads `scene.yaml` of the scene folder `path`.

    Raises:
        ValueError: for unknown or missing fields, values of the wrong kind, vectors that have not
            three finite components and a format version that is not known.
    """
    file = Path(path) / "scene.yaml"
    try:
        metadata = yaml_load_typed(schema=SceneMetadata, filename=str(file))
    except (RuntimeError, ValueError, TypeError, yaml.YAMLError) as error:
        raise ValueError(f"{file}: {error}; reconstruct the scene again or repair it") from error
    if metadata.format_version != FORMAT_VERSION:
        raise ValueError(
            f"{file}: format version {metadata.format_version}, this program knows "
            f"{FORMAT_VERSION}; use the version of the program that wrote the scene"
        )
    for name in ("lower_W", "upper_W", "background", "p_WS", "p_WG"):
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
    *,
    provenance: str,
    gains: Sequence[float] = (),
    vignetting: float = 0.0,
    metric: bool = True,
    representation: str = "3dgs",
    capture: str = "",
    held_out: Sequence[int] = (),
    image_width: int = 0,
) -> SceneMetadata:
    """Writes `world` as a scene folder and returns what its `scene.yaml` says; see `SceneMetadata`
    for what is said about it.

    The folder appears whole: it is written beside its place and renamed. A scene that stands there
    is replaced. Only the grid of the distance field is kept.

    Raises:
        ValueError, OSError: see `check_scene_target`; or if the disk is full.
    """
    path = Path(path).absolute()
    check_scene_target(path)
    esdf = world.esdf
    metadata = SceneMetadata(
        name=world.name,
        provenance=provenance,
        metric=metric,
        lower_W=[float(x) for x in esdf.lower_W],
        upper_W=[float(x) for x in esdf.upper_W],
        observed_free_volume=esdf.volume(FieldState.FREE),
        gains=[float(gain) for gain in gains],
        vignetting=float(vignetting),
        background=[float(x) for x in world.background],
        p_WS=[float(x) for x in world.p_WS],
        p_WG=[float(x) for x in world.p_WG],
        representation=representation,
        capture=capture,
        held_out=[int(frame) for frame in held_out],
        image_width=image_width,
    )
    new = path.with_name(f".{path.name}.{os.getpid()}.new")
    old = path.with_name(f".{path.name}.{os.getpid()}.old")
    try:
        new.mkdir(parents=True)
        write_ply(world.gaussians, new / "gaussians.ply")
        esdf.save(new / "esdf.npz")
        yaml_dump_typed(metadata, filename=str(new / "scene.yaml"))
        if path.exists():
            path.rename(old)
        new.rename(path)
    finally:
        shutil.rmtree(new, ignore_errors=True)
        if old.exists() and not path.exists():
            old.rename(path)
        shutil.rmtree(old, ignore_errors=True)
    return metadata


def _read_bare_ply(path: Path) -> World:
    """Builds a world from Gaussians alone: every place that no Gaussian fills counts as free."""
    gaussians = read_ply(path)
    # A few stray Gaussians far away must not stretch the grid; beyond it all counts as occupied.
    lower_W, upper_W = np.percentile(gaussians.means.astype(float), [1, 99], axis=0)
    lower_W, upper_W = lower_W - 0.1, upper_W + 0.1
    voxel_size = max(0.1, float(np.cbrt(np.prod(upper_W - lower_W) / _MAX_VOXELS)))
    if voxel_size > _COARSEST:
        raise ValueError(
            f"{path}: 98 % of the Gaussians span {np.round(upper_W - lower_W, 1).tolist()} m, for "
            f"which voxels of {voxel_size:.2f} m would be needed, more than {_COARSEST} m; crop "
            "far Gaussians away, and scale the scene if its unit is not the metre"
        )
    esdf = esdf_from_gaussians(gaussians, voxel_size, lower_W, upper_W)
    p_WS, p_WG, _ = choose_start_and_goal(esdf, VEHICLE_RADIUS)
    return World(
        name=path.stem,
        gaussians=gaussians,
        distance_field=esdf,
        esdf=esdf,
        background=(0.0, 0.0, 0.0),
        p_WS=p_WS,
        p_WG=p_WG,
    )
