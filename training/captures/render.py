"""Captures rendered of meshes and generated worlds, with exact depth."""

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform

from splatpilot.diagrams.flight.scenario import Scenario
from splatpilot.diagrams.scenarios import benchmark_scenarios
from splatpilot.diagrams.worlds.building_blocks import suitable_voxel
from splatpilot.diagrams.worlds.mesh import check_mesh, mesh_digests, mesh_distance
from splatpilot.diagrams.worlds.mesh_renderer import MeshRenderer
from splatpilot.diagrams.worlds.splits import check_split, choose_split, part_digests, source_digest
from splatpilot.diagrams.worlds.world_gltf import write_gltf
from splatpilot.diagrams.worlds.world_registry import WorldConfig, is_procedural, make_spec
from splatpilot.systems.collision.esdf import Esdf
from splatpilot.systems.collision.esdf_build import esdf_from_distance_field
from splatpilot.systems.common.config import dump_config, load_config
from splatpilot.systems.common.distributions import sample_distributions
from splatpilot.systems.common.files import (
    locked_folder,
    require_writable_folder,
    write_text,
    written_atomically,
)
from splatpilot.systems.common.progress import Progress, resumable
from splatpilot.systems.common.provenance import TRAINING_SEEDS, VALIDATION_SEEDS
from splatpilot.systems.common.validation import Config, bounded, require, require_field
from splatpilot.training.captures.capture import CaptureFrame
from splatpilot.training.captures.coverage import CapturePlan, plan_capture, poses_along, resample
from splatpilot.training.captures.frames import pose_row
from splatpilot.training.captures.tartanair import AXES, intrinsics

_log = logging.getLogger(__name__)


@dataclass(kw_only=True)
class RenderConfig(Config):
    """Options of a rendered capture."""

    width: int = bounded(640, "[8, 4096] px")  # of the images
    height: int = bounded(480, "[8, 4096] px")  # of the images
    # [m] Points x, y, z of the camera path; empty: poses that see all surfaces around the free
    # space, see `plan_capture`.
    path: list[list[float]] = field(default_factory=list)
    lowest: float = bounded(1.0, "[0, inf) m")  # height of planned poses above the surface below
    highest: float = bounded(2.2, "(0, inf) m")  # the same, at most
    views: int = bounded(3, "[1, 26]")  # directions from which planned poses see each surface
    reach: float = bounded(0.0, "[0, inf) m")  # of planned poses; 0: 4 m, or up to 10 m outdoors
    max_frames: int = bounded(600, "[1, inf)")  # number of planned poses
    # [m] A point x, y, z in the space to capture; empty: in the largest that does not lead out.
    inside: list[float] = bounded(list, "(-inf, inf) m")
    clearance: float = bounded(0.5, "[0, inf) m")  # of the camera from surfaces
    spacing: float = bounded(0.6, "[0.01, inf) m")  # between stops on a given path
    # [deg] Viewing directions at each stop of it, from that of travel to the left.
    yaws: list[float] = bounded(lambda: [0.0, 90.0, -90.0], "(-inf, inf) deg")
    pitch: float = bounded(-5.0, "(-90, 90) deg")  # of the camera there, upward
    # [m] To the camera's left, negative to its right: each adds a second capture `offset_...` of
    # the poses that are free there.
    offsets: list[float] = bounded(list, "(-inf, inf) m")
    up: str = bounded("y", "{y, z}")  # axis of the file that points up: y, as glTF says, or z
    scale: float = bounded(1.0, "(0, inf) m")  # unit of the mesh
    # Color of the background; red, green, blue in 0 to 1.
    background: list[float] = bounded(lambda: [0.6, 0.75, 0.9], "[0, 1]")
    # Of the grid in which poses are planned; 0: 0.1 m, or more for 20 million voxels.
    voxel_size: float = bounded(0.0, "[0, inf) m")
    # Split of scenes of the capture: train, validation or test. Empty: train, but test for what
    # the benchmark tests in, and for its worlds of seeds below those of training.
    split: str = ""

    def check(self) -> None:
        check_split(self.split)
        require_field(self, "lowest", self.lowest < self.highest, f"below highest, {self.highest}")
        require_field(self, "inside", len(self.inside) in (0, 3), "x, y, z, or empty")
        require_field(self, "yaws", self.yaws, "at least one angle")
        distinct = len(set(map(_offset_folder, self.offsets))) == len(self.offsets)
        valid = all(self.offsets) and distinct
        require_field(self, "offsets", valid, "other than 0, and different in centimeters")
        require_field(self, "background", len(self.background) == 3, "red, green and blue")


def _offset_folder(offset: float) -> str:
    return f"offset_{offset:+.2f}"


RECIPE = "world.yaml"
COVERAGE = "coverage.png"
_COVERED = 0.8  # share of surfaces, below which a capture is warned about
_VERSION = 4  # of the drawing of meshes


@dataclass
class RenderedWorld:
    """The content of `world.yaml`, from which more of a captured world can be rendered."""

    mesh: str = ""  # absolute or relative to the capture
    origin: str = ""  # file or scenario that it was made from
    config: RenderConfig = field(default_factory=RenderConfig)
    split: str = ""  # of scenes of the capture: train, validation or test
    source_digest: list[str] = field(default_factory=list)  # see `splits.source_digest`
    version: int = 1  # of the drawing of meshes


def run(*, world: str | Path, out: str | Path, config: RenderConfig, seed: int = 0) -> None:
    """Renders a capture of a world to the folder `out`, as a TartanAir V1 sequence.

    `world` is a mesh (.gltf, .glb or .obj) or a scenario ("P02", or a .yaml file) of a procedural
    world, which is drawn from `seed` and exported as `world.gltf` into the capture. Frames are
    collected in `.NAME.partial` next to `out`, where the same call resumes.
    """
    config.validate()
    out = Path(out).absolute()
    world = benchmark_scenarios().get(str(world)) or Path(world).absolute()
    partial = out.with_name(f".{out.name}.partial")
    images = partial / "image_left"

    def kept() -> str:
        count = len(list(images.glob("*.png")))
        return f"{count} frames are in {partial}; the same command resumes there"

    with locked_folder(partial), resumable(kept):
        _render(world, out, partial, config, seed)


def _render(world: Path, out: Path, partial: Path, config: RenderConfig, seed: int) -> None:
    spec = None
    if world.suffix in (".yaml", ".yml"):
        scenario = load_config(Scenario(), world)
        if not is_procedural(scenario.world):
            raise ValueError(
                f"{world}: its world must be a generated one, got {type(scenario.world).__name__}"
            )
        spec = make_spec(scenario.world, seed)
        recipe = RenderedWorld("world.gltf", f"{world.name}, seed {seed}", config, version=_VERSION)
        shown = _shown(scenario.world, seed)
        described = f"{type(shown).__name__} {seed}\n{dump_config(shown)}"
        digests, found = part_digests([described.encode()]), _generated_split(scenario.world, seed)
    else:
        check_mesh(world)
        recipe = RenderedWorld(str(world), world.name, config, version=_VERSION)
        digests, found = mesh_digests(world), "train"
    recipe.split = choose_split(recipe.origin, digests, config.split, found)
    recipe.source_digest = source_digest(digests)
    text = dump_config(recipe)

    def has_recipe(folder: Path) -> bool:
        file = folder / RECIPE
        return file.is_file() and file.read_text() == text

    if has_recipe(out):
        print(f"{out}: is complete already")
        return
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise ValueError(
            f"{out}: holds something other than this capture; choose another folder, or remove it"
        )
    if (partial / RECIPE).is_file() and not has_recipe(partial):
        raise ValueError(
            f"{partial}: holds a part of another capture; remove it, or repeat that command"
        )
    if spec is None:
        esdf = mesh_distance(world, config.up, config.voxel_size, config.scale)
    else:
        bounds = spec.distance_field.lower_W, spec.distance_field.upper_W
        voxel_size = config.voxel_size or suitable_voxel(*bounds)
        esdf = esdf_from_distance_field(spec.distance_field, voxel_size)
    plan = None if config.path else _plan(esdf, config)
    X_WCs = _poses_on_path(esdf, config) if plan is None else plan.X_WCs
    write_text(partial / RECIPE, text)
    mesh = partial / recipe.mesh
    if spec is not None and not mesh.is_file():
        write_gltf(spec, mesh)
    view = _camera(mesh, config)
    _write_frames(partial, "rendering frames", X_WCs, view)
    for offset in config.offsets:
        moved = [X_WC @ RigidTransform(np.array([-offset, 0.0, 0.0])) for X_WC in X_WCs]
        free = [X_WC for X_WC in moved if _is_free(esdf, X_WC.translation(), config.clearance)]
        _write_frames(partial / _offset_folder(offset), f"offset {offset:+.2f} m", free, view)
    if plan is not None:
        _write_png(partial / COVERAGE, plan.picture())
    if out.exists():
        out.rmdir()
    partial.rename(out)
    length = np.linalg.norm(np.diff([X.translation() for X in X_WCs], axis=0), axis=1).sum()
    print(f"{out}: {len(X_WCs)} frames of {config.width}x{config.height} along {length:.1f} m")


def true_camera(capture: Path) -> Callable[[RigidTransform], CaptureFrame] | None:
    """Returns a function that renders the world of a rendered capture at X_WC; None of others."""
    recipe = rendered_world(capture)
    if recipe is None:
        return None
    what, remedy = f"{capture / RECIPE}: version", "render it again"
    require(recipe.version == _VERSION, what, f"{_VERSION}", recipe.version, remedy)
    recipe.config.validate()
    return _camera(capture / recipe.mesh, recipe.config)


def _camera(mesh: Path, config: RenderConfig) -> Callable[[RigidTransform], CaptureFrame]:
    """Returns a function that renders a mesh with a camera as TartanAir's, 90 degrees wide."""
    renderer = MeshRenderer(mesh, config.up, config.background, config.scale)
    size = config.width, config.height
    K = intrinsics(*size)
    return lambda X_WC: CaptureFrame(*renderer.render(X_WC, K, *size), X_WC, K)


def rendered_world(capture: Path) -> RenderedWorld | None:
    """Returns the world that a capture was rendered of; None if it was not rendered."""
    file = capture / RECIPE
    return load_config(RenderedWorld(), file) if file.is_file() else None


def _generated_split(world: WorldConfig, seed: int) -> str:
    """Returns the split of a generated world: that of its seed if the benchmark flies in it."""
    worlds = [load_config(Scenario(), file).world for file in benchmark_scenarios().values()]
    if _shown(world, seed) not in [_shown(each, seed) for each in worlds]:
        return "train"
    if seed < TRAINING_SEEDS:
        return "test"
    return "train" if seed < VALIDATION_SEEDS else "validation"


def _shown(world: WorldConfig, seed: int) -> Any:
    """Returns the sampled configuration of a world without the voxel size, which is not visible."""
    drawn = sample_distributions(world, seed, ("world",))
    if not hasattr(drawn, "voxel_size"):
        return drawn
    return replace(drawn, voxel_size=type(drawn)().voxel_size)  # pyright: ignore


def _poses_on_path(esdf: Esdf, config: RenderConfig) -> list[RigidTransform]:
    X_WCs = poses_along(np.array(config.path), config.spacing, config.yaws, config.pitch)
    stops = np.array([X_WC.translation() for X_WC in X_WCs])
    for p_W in resample(stops, esdf.voxel_size / 2):
        if not _is_free(esdf, p_W, min(config.clearance, esdf.voxel_size)):
            raise ValueError(
                f"the path touches something at {np.round(p_W, 2).tolist()} m; lead it around"
            )
    return X_WCs


def _plan(esdf: Esdf, config: RenderConfig) -> CapturePlan:
    size = config.width, config.height
    plan = plan_capture(
        esdf,
        intrinsics(*size),
        size,
        (config.lowest, config.highest),
        config.clearance,
        config.views,
        config.reach,
        config.max_frames,
        np.array(config.inside) if config.inside else None,
    )
    once, possible = np.mean(plan.views > 0), np.mean(plan.possible >= config.views)
    print(
        f"{len(plan.X_WCs)} poses in {plan.free_area:.0f} m^2 see {plan.coverage:.0%} of the "
        f"surfaces from {config.views} directions ({possible:.0%} are possible) and {once:.0%} at "
        f"least once, within {plan.reach:.1f} m"
    )
    for area, p_W in plan.others[:3]:
        _log.warning(
            "%.0f m^2 around %s m are not captured: with a clearance of %g m no path leads there; "
            "set less clearance, or inside",
            area,
            np.round(p_W, 1).tolist(),
            config.clearance,
        )
    if plan.coverage < _COVERED:
        remedies = [f"see {COVERAGE} of the capture for where"]
        if plan.more_frames:
            count = config.max_frames + plan.more_frames
            remedies.append(f"set max_frames={count}")
        if possible < _COVERED:
            remedies.append("allow other heights, or less clearance")
        _log.warning(
            "only %.0f %% of the surfaces are seen from %d directions; %s",
            100 * plan.coverage,
            config.views,
            "; ".join(remedies),
        )
    return plan


def _write_png(path: Path, image: NDArray[np.uint8]) -> None:
    with written_atomically(path) as file:
        file.write_bytes(cv2.imencode(".png", image[..., ::-1])[1].tobytes())


def _is_free(esdf: Esdf, p_WQ: NDArray, clearance: float) -> bool:
    # Outside the grid, where distance is NaN, all is free.
    return not esdf.distance(p_WQ) < clearance


def _write_frames(
    folder: Path,
    what: str,
    X_WCs: Sequence[RigidTransform],
    view: Callable[[RigidTransform], CaptureFrame],
) -> None:
    """Writes the missing frames of a TartanAir V1 sequence."""
    images, depths = folder / "image_left", folder / "depth_left"
    for part in (images, depths):
        require_writable_folder(part)
    R_FW, R_CB = (RigidTransform(each.inverse()) for each in (AXES.R_WF, AXES.R_BC))
    rows = []
    for i, X_WC in enumerate(Progress(X_WCs, what, unit="frame")):
        rows.append(f"{pose_row(R_FW @ X_WC @ R_CB)}\n")
        image, depth = images / f"{i:06d}_left.png", depths / f"{i:06d}_left_depth.npy"
        if image.is_file() and depth.is_file():
            continue
        frame = view(X_WC)
        with written_atomically(depth) as file:
            np.save(file, frame.depth)
        _write_png(image, frame.image)
    write_text(folder / "pose_left.txt", "".join(rows))
