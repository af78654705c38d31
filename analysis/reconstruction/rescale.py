"""A finished scene folder in another scale: metres, where its unit of length was unknown."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydrake.math import RigidTransform, RotationMatrix

from splatpilot.diagrams.worlds.scene_folder import (
    FRONTIER,
    SceneMetadata,
    check_scene_target,
    close_frontier,
    read_background,
    read_scene_metadata,
    write_scene_folder,
)
from splatpilot.diagrams.worlds.world import World
from splatpilot.systems.collision.esdf import Esdf
from splatpilot.systems.common.config import load_config
from splatpilot.systems.common.files import require_writable_folder
from splatpilot.systems.splats.scene import GaussianScene
from splatpilot.systems.splats.splat_files import read_ply, read_splats, write_ply
from splatpilot.training.captures.capture import shrink_factor
from splatpilot.training.captures.capture_config import CaptureConfig, complete_config
from splatpilot.training.captures.capture_registry import read_capture_of
from splatpilot.training.captures.up_and_scale import camera_height
from splatpilot.training.reconstruction.config import ReconstructConfig
from splatpilot.training.reconstruction.distance_field import render_depth
from splatpilot.training.reconstruction.reconstruct import start_and_goal

# Rows are W's axes in the file's, by which of those is up; x stays where it can.
_R_WF = {
    "z": [[1, 0, 0], [0, 1, 0], [0, 0, 1]],
    "-z": [[1, 0, 0], [0, -1, 0], [0, 0, -1]],
    "y": [[1, 0, 0], [0, 0, -1], [0, 1, 0]],
    "-y": [[1, 0, 0], [0, 0, 1], [0, -1, 0]],
    "x": [[0, 1, 0], [0, 0, 1], [1, 0, 0]],
    "-x": [[0, -1, 0], [0, 0, 1], [-1, 0, 0]],
}
UP_AXES = tuple(_R_WF)
"""Which way can be up in a file."""

_FLATTEST = 0.05  # of a triangle on the floor, twice its area over its longest side squared
_STEEPEST = 0.5  # cosine between a floor's normal and the axis that points up


@dataclass(frozen=True)
class FileSummary:
    """What was written."""

    file: Path
    gaussians: int
    factor: float
    size: NDArray[np.float64]  # (3,) [m], of the box of nearly all Gaussians
    origin: tuple[float, float, float]  # [m], of the written file in the other, scaled and turned

    def __str__(self) -> str:
        rows = {
            "file": self.file,
            "Gaussians": self.gaussians,
            "factor": f"{self.factor:.6g}",
            "size": " x ".join(f"{length:.3g}" for length in self.size) + " m",
        }
        if any(self.origin):
            rows["relative to [m]"] = ", ".join(f"{x:.10g}" for x in self.origin)
        return "\n".join(f"{name:<18} {value}" for name, value in rows.items())


def rescale_file(
    file: Path,
    out: Path,
    factor: float = 1.0,
    up: str = "z",
    floor: Sequence[ArrayLike] = (),
) -> FileSummary:
    """Writes the Gaussians of a file as PLY, all lengths times `factor`, turned so that z is up.

    Args:
        file: see `read_splats`.
        out: the PLY.
        factor: what one of the file's units is [m].
        up: which of the file's axes points up, one of `UP_AXES`; the PLYs of 3D Gaussian splatting
            mostly have -y there.
        floor: three points (3,) of the file's floor, or of another level surface: it becomes level,
            at z = 0, and `up` tells only its upper side.

    Raises:
        FileNotFoundError, ValueError: for a file that is damaged or none of Gaussians, three points
            that are no floor, or `out` that is no name of a PLY or exists.
        OSError: if it cannot be written.
    """
    if out.suffix.lower() != ".ply":
        raise ValueError(f"{out}: Gaussians are written as PLY; name it so, {out.stem}.ply")
    if out.exists():
        raise ValueError(f"{out}: exists already; choose another name for the scaled file")
    require_writable_folder(out.absolute().parent)
    X_WF = _upright(up, floor)
    gaussians = read_splats(file).transformed_by(X_WF).scaled_by(factor)
    write_ply(gaussians, out)
    lower_W, upper_W = np.percentile(gaussians.means.astype(float), [1, 99], axis=0)
    return FileSummary(out, len(gaussians), factor, upper_W - lower_W, gaussians.origin)


def _upright(up: str, floor: Sequence[ArrayLike]) -> RigidTransform:
    """X_WF, from the axis that points up and perhaps three points of the floor."""
    R_WF = np.array(_R_WF[up], dtype=float)
    if not len(floor):
        return RigidTransform(RotationMatrix(R_WF))
    a, b, c = (np.asarray(point, dtype=float) for point in floor)
    normal = np.cross(b - a, c - a)
    area, longest = np.linalg.norm(normal), max(np.linalg.norm(b - a), np.linalg.norm(c - a))
    if not area > _FLATTEST * longest**2:
        raise ValueError(
            f"the points {a.tolist()}, {b.tolist()} and {c.tolist()} lie in a line, or are one; "
            "give three corners of a floor"
        )
    z_F = normal / area
    steep = float(z_F @ R_WF[2])
    if abs(steep) < _STEEPEST:
        raise ValueError(
            f"the plane of these points stands at {np.rad2deg(np.arccos(abs(steep))):.0f} degrees "
            f"to a floor that has {up} up; say which axis points up, or choose other points"
        )
    z_F *= np.sign(steep)
    x_F = R_WF[0] - (R_WF[0] @ z_F) * z_F
    x_F /= np.linalg.norm(x_F)
    R = RotationMatrix(np.stack([x_F, np.cross(z_F, x_F), z_F]))
    return RigidTransform(R, np.array([0.0, 0.0, -(z_F @ a)]))


@dataclass(frozen=True)
class RescaleSummary:
    """What was made."""

    scene: Path
    factor: float
    size: NDArray[np.float64]  # (3,) [m], of the distance field's box
    geodesic: float  # [m], length of the shortest path from start to goal
    warnings: tuple[str, ...] = ()

    def __str__(self) -> str:
        rows = {
            "scene": self.scene,
            "factor": f"{self.factor:.6g}",
            "size": " x ".join(f"{length:.3g}" for length in self.size) + " m",
            "shortest path [m]": f"{self.geodesic:.1f}",
        }
        lines = [f"{name:<18} {value}" for name, value in rows.items()]
        return "\n".join(lines + [f"warning: {warning}" for warning in self.warnings])


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
) -> RescaleSummary | FileSummary:
    """Writes a scene folder anew as `out`, see `rescale`, or a file of Gaussians, see
    `rescale_file`, and prints what it is.

    Args:
        factor: of all lengths; or
        between, distance: two points (3,) of the scene, and the metres between them; or
        height: [m], median height of the capture's cameras above the ground.
        up, floor: which way is up in a file, see `rescale_file`; scene folders have z up.

    Raises:
        FileNotFoundError, ValueError, OSError: see `rescale` and `rescale_file`; or if the two
            points are one, a length is not positive, or no height of the cameras can be found in
            the capture.
    """
    if scene.is_file() and height is not None:
        raise ValueError(f"{scene}: a file has no cameras; give a factor, or points and a distance")
    if scene.is_dir() and (up is not None or len(floor)):
        raise ValueError(f"{scene}: z is up in scene folders; leave --up and --floor out")
    if distance is not None:
        a, b = (np.asarray(p, dtype=float) for p in between)
        if not (length := float(np.linalg.norm(a - b))) > 0:
            raise ValueError(f"both points are {a.tolist()}; two places are needed")
        factor = _positive("distance", distance) / length
    elif height is not None:
        factor = _positive("height", height) / camera_height(
            read_capture_of(scene, read_scene_metadata(scene))
        )
    elif factor is None and (up is not None or len(floor)):
        factor = 1.0
    if factor is None:
        raise ValueError("give a factor, two points and the distance between them, or a height")
    if scene.is_file():
        summary = rescale_file(scene, out, _positive("factor", factor), up or "z", floor)
    else:
        summary = rescale(scene, out, factor)
    print(summary)
    return summary


def rescale(scene: Path, out: Path, factor: float) -> RescaleSummary:
    """Writes the scene folder `scene` anew as `out`, all its lengths times `factor`, in metres.

    It is what reconstruction would have written of the capture in that scale: start and goal are
    chosen for the vehicle, and a place whose scale was unknown is closed where nobody looked
    (`close_frontier`). The grid of the distance field stays; its voxels grow. What was measured of
    the scene is not copied, `splatpilot measure` and `fidelity` measure the new one.

    Raises:
        FileNotFoundError, ValueError, OSError: for a damaged scene, a factor that is not positive,
            or if `out` exists or cannot be written.
    """
    _positive("factor", factor)
    if out.exists():
        raise ValueError(f"{out}: exists already; choose another folder for the scaled scene")
    check_scene_target(out)
    metadata = read_scene_metadata(scene)
    gaussians = read_ply(scene / "gaussians.ply").scaled_by(factor)
    field = Esdf.load(scene / "esdf.npz").scaled_by(factor)
    about, warnings = _about_capture(metadata, factor)
    frontier = None
    if metadata.frontier:
        frontier = read_ply(scene / FRONTIER).scaled_by(factor)
    elif not metadata.metric:
        try:
            field, frontier = _closed(scene, about, gaussians, field)
        except (ValueError, OSError) as error:
            warnings += (f"where nobody looked the scene stays open: {error}",)
    ends = factor * np.array(metadata.p_WS), factor * np.array(metadata.p_WG)
    p_WS, p_WG, geodesic, unflyable = start_and_goal(field, True, ends)
    background = read_background(scene, metadata)
    write_scene_folder(
        out,
        World(metadata.name, gaussians, field, field, background, p_WS, p_WG),
        frontier,
        provenance=f"{metadata.provenance}, scaled by {factor:.6g}",
        gains=about.gains,
        vignetting=about.vignetting,
        representation=metadata.representation,
        capture=about.capture,
        capture_settings=about.capture_settings,
        capture_notes=about.capture_notes,
        origin=about.origin,
        held_out=about.held_out,
        image_width=about.image_width,
        split=metadata.split,
        source_digest=metadata.source_digest,
    )
    size = field.upper_W - field.lower_W
    return RescaleSummary(out, factor, size, geodesic, (*warnings, *unflyable))


def _about_capture(metadata: SceneMetadata, factor: float) -> tuple[SceneMetadata, tuple[str, ...]]:
    """What a scene in another scale says of its capture, and warnings.

    The settings with which the capture is opened again give its poses the same scale. Where they
    cannot, because its metres are those of measured depth, the scene names no capture any more.
    """
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
        forgotten = replace(
            metadata,
            capture="",
            capture_settings=[],
            capture_notes=[],
            held_out=[],
            gains=[],
            image_width=0,
        )
        warning = (
            f"{metadata.capture} has metres of its own: the scaled scene is not compared to it"
        )
        return forgotten, (warning,)
    return replace(metadata, capture_settings=config.settings()), ()


def _closed(
    scene: Path, about: SceneMetadata, gaussians: GaussianScene, field: Esdf
) -> tuple[Esdf, GaussianScene | None]:
    """The scene closed where nobody looked any further, as its capture tells; `close_frontier`."""
    capture = read_capture_of(scene, about)
    factor = shrink_factor(capture.width, about.image_width)
    threads = ReconstructConfig().renderer_threads
    depth = render_depth(capture, factor, gaussians, about.representation, threads)
    return close_frontier(field, depth.images(), depth.K, depth.X_WCs)


def _positive(name: str, value: float) -> float:
    if not 0 < value < math.inf:
        raise ValueError(f"{name} is {value}; it must be positive and finite")
    return value
