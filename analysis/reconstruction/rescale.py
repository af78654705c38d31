"""Metric scale of a finished scene folder, or of a file of Gaussians."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydrake.math import RigidTransform, RotationMatrix

from splatpilot.diagrams.worlds import scene_folder
from splatpilot.diagrams.worlds.world import World
from splatpilot.systems.collision.depth_fusion import swept_space
from splatpilot.systems.collision.distance_field import FieldState
from splatpilot.systems.collision.esdf import Esdf
from splatpilot.systems.collision.observations import Observations
from splatpilot.systems.common.config import load_config
from splatpilot.systems.common.files import require_writable_folder
from splatpilot.systems.common.validation import require
from splatpilot.systems.splats.splat_files import (
    WRITTEN,
    read_ply,
    read_splats,
    sog_meta,
    write_splats,
)
from splatpilot.systems.vehicle.quadrotor import VEHICLE_RADIUS
from splatpilot.training.captures.capture import shrink_factor
from splatpilot.training.captures.capture_config import CaptureConfig, complete_config
from splatpilot.training.captures.capture_registry import read_scene_capture
from splatpilot.training.captures.up_and_scale import camera_height
from splatpilot.training.reconstruction.config import ReconstructConfig
from splatpilot.training.reconstruction.distance_field import keep_confirmed, render_depth
from splatpilot.training.reconstruction.reconstruct import with_default_route

_KEPT = ("gains", "vignetting", "representation", "capture", "capture_settings", "capture_notes")
_KEPT += ("origin", "held_out", "image_width", "split", "source_digest")
"""Metadata that a scaled scene keeps."""
_MIN_AREA = 0.05  # twice the area of a triangle on the floor, over its longest side squared
_MIN_COSINE = 0.5  # between a floor's normal and the axis that is up


@dataclass(frozen=True)
class RescaleSummary:
    """A scaled scene folder, or a written file of Gaussians."""

    out: Path
    factor: float
    size: NDArray[np.float64]  # (3,) [m], of the distance field, or of 98 % of the Gaussians
    details: dict[str, str]
    warnings: tuple[str, ...] = ()

    def __str__(self) -> str:
        rows = {
            "file" if self.out.is_file() else "scene": self.out,
            "factor": f"{self.factor:.6g}",
            "size": " x ".join(f"{length:.3g}" for length in self.size) + " m",
            **self.details,
        }
        lines = [f"{name:<18} {value}" for name, value in rows.items()]
        return "\n".join([*lines, *(f"warning: {warning}" for warning in self.warnings)])


def rescale_file(
    file: Path, out: Path, factor: float, up: str, floor: Sequence[ArrayLike]
) -> RescaleSummary:
    """Writes the Gaussians of a file as PLY, SPZ, glTF or USD, in meters. Its axis `up` becomes z,
    or y of glTF; the plane of three points (3,) of `floor`, if given, becomes z = 0."""
    suffix = out.suffix.lower()
    require(suffix in WRITTEN, f"{out}: the suffix", f"one of {', '.join(WRITTEN)}", repr(suffix))
    if out.exists():
        raise ValueError(f"{out}: exists already; choose another name for the scaled file")
    require_writable_folder(out.absolute().parent)
    X_WF = _upright(up, floor)
    gaussians = read_splats(file).transformed_by(X_WF).scaled_by(factor)
    write_splats(gaussians, out)
    lower_W, upper_W = np.percentile(gaussians.means.astype(float), [1, 99], axis=0)
    details = {"Gaussians": str(len(gaussians))}
    if any(gaussians.origin):
        details["relative to [m]"] = ", ".join(f"{x:.10g}" for x in gaussians.origin)
    return RescaleSummary(out, factor, upper_W - lower_W, details)


def _upright(up: str, floor: Sequence[ArrayLike]) -> RigidTransform:
    """Returns X_WF, given the axis that points up and optionally three points of the floor."""
    sign, k = -1.0 if up.startswith("-") else 1.0, "xyz".index(up[-1])
    z_F = sign * np.eye(3)[k]
    x_F = np.eye(3)[0] if k else np.roll(z_F, 1)  # x is kept if possible
    origin = 0.0
    if len(floor):
        a, b, c = (np.asarray(point, dtype=float) for point in floor)
        normal = np.cross(b - a, c - a)
        area, longest = np.linalg.norm(normal), max(np.linalg.norm(b - a), np.linalg.norm(c - a))
        if not area > _MIN_AREA * longest**2:
            raise ValueError(
                f"the points {a.tolist()}, {b.tolist()} and {c.tolist()} lie in a line; give three "
                "corners of a floor"
            )
        cosine = float(normal @ z_F / area)
        if abs(cosine) < _MIN_COSINE:
            raise ValueError(
                f"the plane of these points is at {np.rad2deg(np.arccos(abs(cosine))):.0f} degrees "
                f"to a floor that has {up} up; give the axis that points up, or other points"
            )
        z_F = np.sign(cosine) * normal / area
        x_F = x_F - (x_F @ z_F) * z_F
        x_F /= np.linalg.norm(x_F)
        origin = -float(z_F @ a)
    R_WF = RotationMatrix(np.stack([x_F, np.cross(z_F, x_F), z_F]))
    return RigidTransform(R_WF, np.array([0.0, 0.0, origin]))


def run(
    *,
    scene: Path,
    out: Path,
    factor: float | None = None,
    between: Sequence[ArrayLike] = (),
    distance: float | None = None,
    height: float | None = None,
    up: str | None = None,
    floor: Sequence[ArrayLike] = (),
) -> RescaleSummary:
    """Scales a scene folder by `rescale`, or a file of Gaussians by `rescale_file`, by a factor, or
    the distance between two points (3,) or the median height of the capture's cameras [m]."""
    is_file = scene.is_file() or sog_meta(scene) is not None
    if is_file and height is not None:
        raise ValueError(f"{scene}: a file has no cameras; give a factor, or points and a distance")
    if not is_file and (up is not None or len(floor)):
        raise ValueError(f"{scene}: z is up in scene folders; leave --up and --floor out")
    if distance is not None:
        a, b = (np.asarray(p, dtype=float) for p in between)
        if not (length := float(np.linalg.norm(a - b))) > 0:
            raise ValueError(f"the points of --between must differ, both are {a.tolist()}")
        factor = _positive("distance", distance) / length
    elif height is not None:
        factor = _positive("height", height) / camera_height(
            read_scene_capture(scene, scene_folder.read_scene_metadata(scene))
        )
    elif factor is None and (up is not None or len(floor)):
        factor = 1.0
    if factor is None:
        raise ValueError("give a factor, two points and the distance between them, or a height")
    if is_file:
        summary = rescale_file(scene, out, _positive("factor", factor), up or "z", floor)
    else:
        summary = rescale(scene, out, factor)
    print(summary)
    return summary


def rescale(scene: Path, out: Path, factor: float) -> RescaleSummary:
    """Writes a scene times `factor`, with a closed frontier, new start and goal, and no metrics."""
    _positive("factor", factor)
    if out.exists():
        raise ValueError(f"{out}: exists already; choose another folder for the scaled scene")
    scene_folder.check_scene_target(out)
    metadata = scene_folder.read_scene_metadata(scene)
    gaussians = scene_folder.read_gaussians(scene).scaled_by(factor)
    field = Esdf.load(scene / scene_folder.ESDF).scaled_by(factor)
    about, warnings = _about_capture(metadata, factor)
    observations = frontier = None
    if (scene / scene_folder.OBSERVATIONS).exists():
        observations = Observations.load(scene / scene_folder.OBSERVATIONS).scaled_by(factor)
    if metadata.frontier:
        frontier = read_ply(scene / scene_folder.FRONTIER).scaled_by(factor)
    elif not metadata.metric:
        try:
            capture = read_scene_capture(scene, about)
            shrunk = shrink_factor(capture.width, about.image_width)
            threads = ReconstructConfig().renderer_threads
            depth = render_depth(capture, shrunk, gaussians, about.representation, threads)
            if not capture.has_depth:  # as `make_distance_field` does
                depth = keep_confirmed(depth, 2.0 * field.voxel_size)
                field = _with_free_path(field, capture.X_WCs)
            field, frontier = scene_folder.close_frontier(
                field, depth.images(), depth.K, depth.X_WCs
            )
        except (ValueError, OSError) as error:
            warnings += (f"the frontier of the scene stays open: {error}",)
    ends = factor * np.array(metadata.p_WS), factor * np.array(metadata.p_WG)
    background = scene_folder.read_background(scene, metadata)
    world = World(
        metadata.name, gaussians, field, field, background, *ends, observations=observations
    )
    world, route, unflyable = with_default_route(world, frontier, True)
    scene_folder.write_scene_folder(
        out,
        world,
        frontier,
        provenance=f"{metadata.provenance}, scaled by {factor:.6g}",
        **{name: getattr(about, name) for name in _KEPT},
    )
    length = route.length
    details = {"shortest path [m]": f"{length:.1f}"} if math.isfinite(length) else {}
    size = field.upper_W - field.lower_W
    return RescaleSummary(out, factor, size, details, (*warnings, *unflyable))


def _with_free_path(field: Esdf, X_WCs: Sequence[RigidTransform]) -> Esdf:
    """Returns a field that is free where the camera, and so the vehicle, has been."""
    grid = field.lower_W, field.states.shape, field.voxel_size
    path = swept_space(X_WCs, *grid, VEHICLE_RADIUS) & (field.states == FieldState.UNKNOWN)
    return replace(field, states=np.where(path, np.uint8(FieldState.FREE), field.states))


def _about_capture(
    metadata: scene_folder.SceneMetadata, factor: float
) -> tuple[scene_folder.SceneMetadata, tuple[str, ...]]:
    """Returns the metadata of a scaled scene about its capture, which is forgotten if its depth
    gives the scale, and warnings."""
    metadata = replace(metadata, origin=[factor * x for x in metadata.origin])
    if not metadata.capture:
        return metadata, ()
    config = load_config(CaptureConfig(), overrides=metadata.capture_settings)
    given = complete_config(Path(metadata.capture), config).scale
    if not metadata.metric:
        config.scale.factor = factor
    elif given.factor or given.distance or given.camera_height:
        for name in ("factor", "distance", "camera_height"):
            setattr(config.scale, name, factor * getattr(given, name))
    else:
        empty = {name: [] for name in ("capture_settings", "capture_notes", "held_out", "gains")}
        forgotten = replace(metadata, capture="", image_width=0, **empty)
        warning = f"{metadata.capture} has metric depth: the scaled scene is not compared to it"
        return forgotten, (warning,)
    return replace(metadata, capture_settings=config.settings()), ()


def _positive(name: str, value: float) -> float:
    require(0 < value < math.inf, name, "finite and > 0", value)
    return value
