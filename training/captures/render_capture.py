"""Captures rendered of meshes: images, exact depth and poses anywhere, as TartanAir V1 has them."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
import trimesh
from numpy.typing import NDArray
from pydrake.math import RigidTransform

from splatpilot.diagrams.scenario import Scenario
from splatpilot.diagrams.scenario_files import benchmark_scenarios
from splatpilot.diagrams.worlds.gltf import write_gltf
from splatpilot.diagrams.worlds.make_world import WorldConfig, is_procedural, make_blueprint
from splatpilot.diagrams.worlds.splits import choose_split, part_digests, source_digest
from splatpilot.systems.array_files import reason_of
from splatpilot.systems.collision.esdf import Esdf
from splatpilot.systems.collision.esdf_build import esdf_from_distance_field, esdf_from_occupancy
from splatpilot.systems.collision.esdf_from_occupancy import grid_shape
from splatpilot.systems.configuration import dump_config, load_config
from splatpilot.systems.files import require_writable_folder, written_atomically
from splatpilot.systems.output_folders import held_folder
from splatpilot.systems.progress import Progress, resumable
from splatpilot.systems.seeds import TRAINING_SEEDS, VALIDATION_SEEDS
from splatpilot.training.captures.camera_path import move_left, poses_along, resample, visiting_path
from splatpilot.training.captures.capture import CaptureFrame
from splatpilot.training.captures.drawn_mesh import drawn_mesh
from splatpilot.training.captures.mesh_renderer import MeshRenderer, check_mesh
from splatpilot.training.captures.render_config import RenderConfig
from splatpilot.training.captures.tartanair import AXES

RECIPE = "world.yaml"
_VERSION = 2
"""Of how meshes are drawn."""
_SAMPLES_PER_VOXEL_FACE = 8


@dataclass
class RenderedWorld:
    """The content of `world.yaml`: what a capture shows, so that more of it can be rendered."""

    # The mesh, absolute or relative to the capture.
    mesh: str = ""
    # What it was made from.
    origin: str = ""
    # How the capture was rendered.
    config: RenderConfig = field(default_factory=RenderConfig)
    # What scenes of the capture are for: train, validation or test.
    split: str = ""
    # Digest of the mesh's triangles, or of the generated world, see `splits.source_digest`.
    source_digest: list[str] = field(default_factory=list)
    # Of how meshes were drawn; 1 where nothing is said.
    version: int = 1


def run(*, world: str | Path, out: str | Path, config: RenderConfig, seed: int = 0) -> None:
    """Renders a capture of a world to the folder `out`.

    Frames are kept in `.NAME.partial` beside `out` until all are there; run again after an
    interruption, it goes on from there. A capture that is there already is left as it is.

    Args:
        world: a mesh (.gltf, .glb or .obj), or a scenario whose world is procedural, one of the
            benchmark's ("P02") or a file (.yaml): that world is exported, with what `seed` draws,
            as `world.gltf` into the capture.

    Raises:
        FileNotFoundError, ValueError, OSError: for a world or settings that cannot be rendered, a
            path through walls, something else in `out`, or a full disk.
    """
    config.validate()
    out = Path(out).absolute()
    world = benchmark_scenarios().get(str(world)) or Path(world).absolute()
    partial = out.with_name(f".{out.name}.partial")
    images = partial / "image_left"

    def kept() -> str:
        count = len(list(images.glob("*.png")))
        return f"{count} frames are in {partial}; the same command resumes there"

    with held_folder(partial), resumable(kept):
        _render(world, out, partial, config, seed)


def _render(world: Path, out: Path, partial: Path, config: RenderConfig, seed: int) -> None:
    blueprint = None
    if world.suffix in (".yaml", ".yml"):
        scenario = load_config(Scenario(), world)
        if not is_procedural(scenario.world):
            raise ValueError(
                f"{world}: its world is a {type(scenario.world).__name__}; a generated one is "
                "needed"
            )
        blueprint = make_blueprint(scenario.world, seed)
        recipe = RenderedWorld("world.gltf", f"{world.name}, seed {seed}", config, version=_VERSION)
        described = f"{type(scenario.world).__name__} {seed}\n{dump_config(scenario.world)}"
        digests, found = part_digests([described.encode()]), _generated_split(scenario.world, seed)
    else:
        check_mesh(world, config.up)
        recipe = RenderedWorld(str(world), world.name, config, version=_VERSION)
        digests, found = mesh_digests(world), "train"
    recipe.split = choose_split(recipe.origin, digests, config.split, found)
    recipe.source_digest = source_digest(digests)
    text = dump_config(recipe)
    if _is_same(out, text):
        print(f"{out}: is rendered already")
        return
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise ValueError(
            f"{out}: holds something other than this capture; choose another folder, or remove it"
        )
    if (partial / RECIPE).is_file() and not _is_same(partial, text):
        raise ValueError(
            f"{partial}: holds a part of another capture; remove it, or repeat what was begun"
        )
    if blueprint is None:
        esdf = mesh_distance(world, config.up, config.voxel_size)
    else:
        esdf = esdf_from_distance_field(blueprint.distance_field, config.voxel_size)
    X_WCs = _poses(esdf, config)
    with written_atomically(partial / RECIPE) as file:
        file.write_text(text)
    mesh = partial / recipe.mesh
    if blueprint is not None and not mesh.is_file():
        write_gltf(blueprint, mesh)
    renderer = _renderer(mesh, config)
    K = intrinsics(config.width, config.height)

    def view(X_WC: RigidTransform) -> CaptureFrame:
        return renderer.frame(X_WC, K, config.width, config.height)

    _write_frames(partial, "rendering frames", X_WCs, view)
    for offset in config.offsets:
        moved = [move_left(X_WC, offset) for X_WC in X_WCs]
        room = [X_WC for X_WC in moved if _has_room(esdf, X_WC.translation(), config.clearance)]
        _write_frames(partial / f"offset_{offset:+.2f}", f"offset {offset:+.2f} m", room, view)
    if out.exists():
        out.rmdir()
    partial.rename(out)
    length = np.linalg.norm(np.diff([X.translation() for X in X_WCs], axis=0), axis=1).sum()
    print(f"{out}: {len(X_WCs)} frames of {config.width}x{config.height} along {length:.1f} m")


def true_camera(capture: Path) -> Callable[[RigidTransform], CaptureFrame] | None:
    """Returns what renders the truth at any pose X_WC of the world that a capture was rendered of,
    in the camera of the capture; None if the capture was not rendered.

    Raises:
        FileNotFoundError, ValueError, OSError: if its world is gone, damaged or cannot be rendered.
    """
    recipe = rendered_world(capture)
    if recipe is None:
        return None
    if recipe.version != _VERSION:
        raise ValueError(
            f"{capture / RECIPE}: version must be {_VERSION}, got {recipe.version}; render it again"
        )
    config = recipe.config
    config.validate()
    renderer = _renderer(capture / recipe.mesh, config)
    K = intrinsics(config.width, config.height)
    return lambda X_WC: renderer.frame(X_WC, K, config.width, config.height)


def rendered_world(capture: Path) -> RenderedWorld | None:
    """Returns what a capture was rendered of; None if it was not rendered.

    Raises:
        ValueError: if its `world.yaml` is damaged.
    """
    file = capture / RECIPE
    return load_config(RenderedWorld(), file) if file.is_file() else None


def intrinsics(width: int, height: int) -> NDArray[np.float64]:
    """Returns K (3, 3) [px] of a camera as TartanAir's: 90 degrees wide, centred."""
    return np.array([[width / 2, 0, width / 2], [0, width / 2, height / 2], [0, 0, 1.0]])


def _generated_split(world: WorldConfig, seed: int) -> str:
    """Returns the split of a generated world, which has that of its seed if it is of the kinds that
    the benchmark flies in."""
    kinds = [load_config(Scenario(), file).world for file in benchmark_scenarios().values()]
    if world not in kinds:
        return "train"
    if seed < TRAINING_SEEDS:
        return "test"
    return "train" if seed < VALIDATION_SEEDS else "validation"


def mesh_digests(mesh: Path) -> set[str]:
    """Returns a digest of each triangle of a mesh, by its corners to a millimeter: whatever the
    file's format, and without its materials.

    Raises:
        ValueError: if the file cannot be read or holds no surface.
    """
    corners = np.round(_read_surface(mesh).triangles * 1000).astype(np.int64)
    packed = corners @ np.array([1 << 42, 1 << 21, 1])  # (N, 3): one number a corner
    triangles = np.unique(np.sort(packed, axis=1), axis=0)
    return part_digests(triangle.tobytes() for triangle in triangles)


def mesh_distance(mesh: Path, up: str, voxel_size: float) -> Esdf:
    """Returns the distance to the surface of a mesh, from points sampled on it.

    Where textures cut holes there is no surface.

    Raises:
        ValueError: if the file cannot be read or holds no surface.
    """
    with drawn_mesh(mesh, up) as drawn:
        p_WQ = drawn.sample(_SAMPLES_PER_VOXEL_FACE / voxel_size**2)
    if not len(p_WQ):
        raise ValueError(f"{mesh}: holds no surface; export it again")
    try:
        grid_shape(p_WQ.min(axis=0) - voxel_size, p_WQ.max(axis=0) + voxel_size, voxel_size)
    except ValueError as error:
        raise ValueError(f"{mesh}: {error}") from None
    lower_W = p_WQ.min(axis=0) - voxel_size
    shape = np.ceil((p_WQ.max(axis=0) + voxel_size - lower_W) / voxel_size).astype(int)
    occupied = np.zeros(shape, dtype=bool)
    occupied[tuple(((p_WQ - lower_W) / voxel_size).astype(int).T)] = True
    return esdf_from_occupancy(occupied, None, lower_W, voxel_size)


def _read_surface(mesh: Path) -> trimesh.Trimesh:
    try:
        surface = trimesh.load(mesh, force="mesh")
        area = surface.area if isinstance(surface, trimesh.Trimesh) else 0.0
    except Exception as error:  # whatever its reader meets in a damaged file
        raise ValueError(
            f"{mesh}: not a readable mesh ({reason_of(error)}); export it again"
        ) from error
    if not isinstance(surface, trimesh.Trimesh) or not 0 < area < np.inf:
        raise ValueError(f"{mesh}: holds no surface; export it again")
    return surface


def _is_same(folder: Path, text: str) -> bool:
    file = folder / RECIPE
    return file.is_file() and file.read_text() == text


def _renderer(mesh: Path, config: RenderConfig) -> MeshRenderer:
    red, green, blue = config.background
    return MeshRenderer(mesh, config.up, (red, green, blue))


def _poses(esdf: Esdf, config: RenderConfig) -> list[RigidTransform]:
    """Returns the camera poses of the path, given or found.

    Raises:
        ValueError: if the path touches something, or none can be found.
    """
    if config.path:
        X_WCs = poses_along(np.array(config.path), config.spacing, config.yaws, config.pitch)
        stops = np.array([X_WC.translation() for X_WC in X_WCs])
        for p_W in resample(stops, esdf.voxel_size / 2):
            if not _has_room(esdf, p_W, min(config.clearance, esdf.voxel_size)):
                raise ValueError(
                    f"the path touches something at {np.round(p_W, 2).tolist()} m; lead it around"
                )
        return X_WCs
    path = visiting_path(
        esdf,
        np.append(esdf.lower_W[:2], config.lowest),
        np.append(esdf.upper_W[:2], config.highest),
        config.clearance,
        config.apart,
    )
    return poses_along(path, config.spacing, config.yaws, config.pitch)


def _has_room(esdf: Esdf, p_WQ: NDArray, clearance: float) -> bool:
    # Outside the grid there is nothing, so that NaN is room enough.
    return not esdf.distance(p_WQ) < clearance


def _write_frames(
    folder: Path,
    what: str,
    X_WCs: Sequence[RigidTransform],
    view: Callable[[RigidTransform], CaptureFrame],
) -> None:
    """Writes the frames that are not there yet, as a TartanAir V1 sequence."""
    images, depths = folder / "image_left", folder / "depth_left"
    for part in (images, depths):
        require_writable_folder(part)
    rows = []
    for i, X_WC in enumerate(Progress(X_WCs, what, unit="frame")):
        rows.append(_row(X_WC))
        image = images / f"{i:06d}_left.png"
        depth = depths / f"{i:06d}_left_depth.npy"
        if image.is_file() and depth.is_file():
            continue
        frame = view(X_WC)
        with written_atomically(depth) as file:
            np.save(file, frame.depth)
        with written_atomically(image) as file:
            _, content = cv2.imencode(".png", np.ascontiguousarray(frame.image[..., ::-1]))
            file.write_bytes(content.tobytes())
    with written_atomically(folder / "pose_left.txt") as file:
        file.write_text("".join(rows))


def _row(X_WC: RigidTransform) -> str:
    """The pose as a line tx ty tz qx qy qz qw in the axes of TartanAir's files."""
    R_FW = AXES.R_WF.inverse()
    R_FB = R_FW @ X_WC.rotation() @ AXES.R_BC.inverse()
    w, x, y, z = R_FB.ToQuaternion().wxyz()
    numbers = (*R_FW.multiply(X_WC.translation()), x, y, z, w)
    return " ".join(f"{number:.17g}" for number in numbers) + "\n"
