"""Captures rendered of meshes and generated worlds, with exact depth."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
import trimesh
from numpy.typing import NDArray
from pydrake.geometry import (
    ClippingRange,
    ColorRenderCamera,
    DepthRange,
    DepthRenderCamera,
    GeometryId,
    LightParameter,
    MakeRenderEngineVtk,
    Mesh,
    PerceptionProperties,
    RenderCameraCore,
    RenderEngineVtkParams,
    RenderLabel,
)
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.systems.sensors import CameraInfo, ImageDepth32F, ImageRgba8U
from scipy.ndimage import gaussian_filter1d
from scipy.sparse.csgraph import connected_components, dijkstra
from scipy.spatial import KDTree

from splatpilot.diagrams.flight.scenario import Scenario
from splatpilot.diagrams.scenarios import benchmark_scenarios
from splatpilot.diagrams.worlds.feasibility import grid_graph
from splatpilot.diagrams.worlds.splits import check_split, choose_split, part_digests, source_digest
from splatpilot.diagrams.worlds.world_gltf import write_gltf
from splatpilot.diagrams.worlds.world_registry import WorldConfig, is_procedural, make_spec
from splatpilot.systems.collision.esdf import Esdf
from splatpilot.systems.collision.esdf_build import (
    esdf_from_distance_field,
    esdf_from_occupancy,
    grid_shape,
)
from splatpilot.systems.common.config import dump_config, load_config
from splatpilot.systems.common.extras import require_opengl
from splatpilot.systems.common.files import held_folder, require_writable_folder, written_atomically
from splatpilot.systems.common.progress import Progress, resumable
from splatpilot.systems.common.readers import reason_of
from splatpilot.systems.common.seeds import TRAINING_SEEDS, VALIDATION_SEEDS
from splatpilot.systems.common.validation import Config, bounded, require, require_field
from splatpilot.systems.splats.scene import GaussianScene
from splatpilot.training.captures.capture import Capture, CaptureFrame, depth_points, pinhole
from splatpilot.training.captures.drawn_mesh import SUFFIXES, drawn_mesh
from splatpilot.training.captures.frames import pose_row
from splatpilot.training.captures.tartanair import AXES


@dataclass(kw_only=True)
class RenderConfig(Config):
    """How a world is captured."""

    width: int = bounded(640, "[8, 4096] px")  # of the images
    height: int = bounded(480, "[8, 4096] px")  # of the images
    # [m] Points x, y, z of the camera path; empty: one that visits all free space between the
    # heights, with a visited point every `apart` along it.
    path: list[list[float]] = field(default_factory=list)
    lowest: float = bounded(1.0, "(-inf, inf) m")  # height of a path that is not given
    highest: float = bounded(2.2, "(-inf, inf) m")  # height of a path that is not given
    apart: float = bounded(3.0, "[0.01, inf) m")  # minimum distance of two visited points
    clearance: float = bounded(0.5, "[0, inf) m")  # of the camera from surfaces
    spacing: float = bounded(0.6, "[0.01, inf) m")  # between stops on the path
    # [deg] Viewing directions at each stop, from that of travel to the left.
    yaws: list[float] = bounded(lambda: [0.0, 90.0, -90.0], "(-inf, inf) deg")
    pitch: float = bounded(-5.0, "(-90, 90) deg")  # of the camera, upward
    # [m] To the camera's left, negative to its right: each adds a second capture `offset_...` of
    # the poses that are free there.
    offsets: list[float] = bounded(list, "(-inf, inf) m")
    up: str = bounded("y", "{y, z}")  # axis of the file that points up: y, as glTF says, or z
    # Color of the background; red, green, blue in 0 to 1.
    background: list[float] = bounded(lambda: [0.6, 0.75, 0.9], "[0, 1]")
    voxel_size: float = bounded(0.1, "[0.01, inf) m")  # of the grid in which the path is planned
    # Split of scenes of the capture: train, validation or test. Empty: train, but test for what
    # the benchmark tests in, and for its worlds of seeds below those of training.
    split: str = ""

    def check(self) -> None:
        check_split(self.split)
        require_field(self, "lowest", self.lowest < self.highest, f"below highest, {self.highest}")
        require_field(self, "yaws", self.yaws, "at least one angle")
        require_field(self, "offsets", all(self.offsets), "other than 0")
        require_field(self, "background", len(self.background) == 3, "red, green and blue")


MIN_DEPTH, MAX_DEPTH = 0.05, 150.0
"""[m], range of the depth images; nearer is 0, farther is inf."""

# Lamps at infinity: one overhead, four from the sides so that no wall is dark or like its
# neighbor, one from below for undersides.
_LAMPS = (
    ((0.15, 0.25, -1.0), 1.6),
    ((1.0, 0.15, -0.5), 1.1),
    ((-1.0, -0.15, -0.5), 1.3),
    ((0.15, 1.0, -0.5), 0.9),
    ((-0.15, -1.0, -0.5), 1.5),
    ((0.2, 0.3, 1.0), 0.8),
)


class MeshRenderer:
    """Renders a mesh.

    Args:
        mesh: .gltf, .glb, or .obj with its materials.
        up: the axis of the file's coordinates that points up, "y" (as glTF says) or "z".
        background: red, green, blue in 0 to 1.

    Raises:
        ValueError, OSError: if the file is missing or damaged, or OpenGL does not work without a
            display.
    """

    def __init__(self, mesh: Path, up: str, background: Sequence[float]):
        _check_mesh(mesh, up)
        require_opengl()
        lights = [
            LightParameter(
                type="directional",
                frame="world",
                direction=np.array(direction),
                intensity=intensity,
            )
            for direction, intensity in _LAMPS
        ]
        self._engine = MakeRenderEngineVtk(
            RenderEngineVtkParams(
                lights=lights, default_clear_color=np.array(background), force_to_pbr=True
            )
        )
        properties = PerceptionProperties()
        properties.AddProperty("label", "id", RenderLabel(1))
        # The engine rotates glTF's y up to z.
        X_WM = RigidTransform(RotationMatrix.MakeXRotation(0.0 if up == "y" else -np.pi / 2))
        with drawn_mesh(mesh, up) as drawn:
            self._cut_outs = drawn.cut_outs
            if drawn.solid is not None:
                try:
                    self._engine.RegisterVisual(
                        GeometryId.get_new_id(), Mesh(str(drawn.solid)), properties, X_WM, False
                    )
                except RuntimeError as error:
                    raise ValueError(
                        f"{mesh}: Drake cannot render it: {error}; export it again"
                    ) from None

    def frame(
        self, X_WC: RigidTransform, K: NDArray[np.float64], width: int, height: int
    ) -> CaptureFrame:
        """Returns the view of a camera at X_WC with intrinsics K (3, 3) [px], with exact depth."""
        # In OpenGL's image plane, too, the principal point of a symmetric view is width / 2.
        info = CameraInfo(width, height, K[0, 0], K[1, 1], K[0, 2], K[1, 2])
        core = RenderCameraCore("", info, ClippingRange(MIN_DEPTH, MAX_DEPTH), RigidTransform())
        color, depth = ImageRgba8U(width, height), ImageDepth32F(width, height)
        self._engine.UpdateViewpoint(X_WC)
        self._engine.RenderColorImage(ColorRenderCamera(core), color)
        self._engine.RenderDepthImage(
            DepthRenderCamera(core, DepthRange(MIN_DEPTH, MAX_DEPTH)), depth
        )
        frame = CaptureFrame(
            np.array(color.data)[..., :3], np.array(depth.data)[..., 0], X_WC, np.array(K)
        )
        return frame if self._cut_outs is None else self._cut_outs.draw(frame, MIN_DEPTH, _LAMPS)


def _check_mesh(mesh: Path, up: str) -> None:
    if not mesh.is_file():
        raise FileNotFoundError(f"No such file: {mesh}")
    suffixes = ", ".join(SUFFIXES)
    require(mesh.suffix in SUFFIXES, f"{mesh}: the suffix", f"one of {suffixes}", mesh.suffix)
    require(up in ("y", "z"), "up", "y (as glTF says) or z", up)


_STEP = 0.05  # [m], of a path while it is smoothed
_ROUNDING = 0.4  # [m], standard deviation of the smoothing of corners


def visiting_path(
    esdf: Esdf,
    lower_W: NDArray[np.float64],
    upper_W: NDArray[np.float64],
    clearance: float,
    apart: float,
) -> NDArray[np.float64]:
    """Returns a path (N, 3) [m] that visits all the free space of a box.

    In the largest connected part of the space with `clearance` [m], stops are chosen farthest from
    those before, along paths, until none is farther than `apart` [m] from one. The path begins at
    the stop in the middle, so that later cameras see its surroundings too, and continues to the
    nearest stop not visited yet, by shortest paths.

    Raises:
        ValueError: if no space has that much clearance.
    """
    spacing = max(esdf.voxel_size, 0.2)
    axes = [
        low + spacing * (np.arange(max(int((high - low) / spacing), 1)) + 0.5)
        for low, high in zip(lower_W, upper_W, strict=True)
    ]
    p_WN = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)  # (nx, ny, nz, 3)
    found = esdf.conservative().distance(p_WN)
    if np.count_nonzero(found > clearance) < 2:
        raise ValueError(
            f"no camera path: the largest clearance from {np.round(lower_W, 1).tolist()} to "
            f"{np.round(upper_W, 1).tolist()} is {found.max():.2f} m, {clearance} m is required; "
            "require less clearance, or allow other heights"
        )
    graph, nodes = grid_graph(found > clearance, spacing)
    p_WF = p_WN.reshape(-1, 3)[nodes]
    _, label = connected_components(graph, directed=False)
    part = label == np.bincount(label).argmax()

    def lengths_from(node: int) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
        lengths, before = dijkstra(graph, directed=False, indices=node, return_predecessors=True)
        lengths[~part] = -1
        return lengths, before

    stops = [int(np.argmax(lengths_from(int(np.argmax(part)))[0]))]
    tables = [lengths_from(stops[0])]
    nearest = tables[0][0].copy()
    while nearest.max() > apart:
        stops.append(int(np.argmax(nearest)))
        tables.append(lengths_from(stops[-1]))
        np.minimum(nearest, tables[-1][0], out=nearest)

    here = min(range(len(stops)), key=lambda k: tables[k][0].max())
    path, left = [stops[here]], set(range(len(stops))) - {here}
    while left:
        lengths, before = tables[here]
        here = min(left, key=lambda k: (lengths[stops[k]], k))
        leg = [stops[here]]
        while leg[-1] != path[-1]:
            leg.append(int(before[leg[-1]]))
        path += leg[-2::-1]
        left.remove(here)
    return p_WF[path]


def poses_along(
    path: NDArray[np.float64], spacing: float, yaws: Sequence[float], pitch: float
) -> list[RigidTransform]:
    """Returns the poses X_WC of a camera that stops on a path, with rounded corners, and turns.

    Args:
        path: (N, 3) [m], N >= 1; a path of one point is one stop that travels along x.
        spacing: [m] between stops.
        yaws: [deg] of the poses of a stop, from the direction of travel to the left.
        pitch: [deg], upward.
    """
    path = np.asarray(path, dtype=np.float64)
    valid = path.ndim == 2 and path.shape[1] == 3 and len(path) and np.isfinite(path).all()
    require(valid, "path", "of finite points x, y, z", f"shape {path.shape}")
    p_WP = resample(path, _STEP)
    if len(p_WP) > 1:
        # Padded point-symmetrically, so that the ends do not move.
        more = min(len(p_WP) - 1, int(4 * _ROUNDING / _STEP))
        p_WP = np.pad(p_WP, ((more, more), (0, 0)), mode="reflect", reflect_type="odd")
        p_WP = gaussian_filter1d(p_WP, _ROUNDING / _STEP, axis=0)[more : len(p_WP) - more]
    p_WP = resample(p_WP, spacing)
    tangent = np.gradient(p_WP, axis=0) if len(p_WP) > 1 else np.array([[1.0, 0, 0]])
    # On climbs the heading stays.
    level = np.linalg.norm(tangent[:, :2], axis=1) > 0.1 * np.linalg.norm(tangent, axis=1)
    last = np.maximum.accumulate(np.where(level, np.arange(len(tangent)), 0))
    headings = np.arctan2(tangent[last, 1], tangent[last, 0])
    return [
        look_along(p, heading + np.deg2rad(yaw), np.deg2rad(pitch))
        for p, heading in zip(p_WP, headings, strict=True)
        for yaw in yaws
    ]


def look_along(p_WC: NDArray[np.float64], yaw: float, pitch: float) -> RigidTransform:
    """Returns the pose X_WC of an upright camera that looks along yaw and up by pitch [rad]."""
    ahead = np.array([np.cos(yaw) * np.cos(pitch), np.sin(yaw) * np.cos(pitch), np.sin(pitch)])
    right = np.array([np.sin(yaw), -np.cos(yaw), 0.0])
    return RigidTransform(
        RotationMatrix(np.column_stack([right, np.cross(ahead, right), ahead])), p_WC
    )


def move_left(X_WC: RigidTransform, offset: float) -> RigidTransform:
    """Returns the pose moved by `offset` [m] to the camera's left, looking where it looked."""
    return RigidTransform(
        X_WC.rotation(), X_WC.translation() - offset * X_WC.rotation().matrix()[:, 0]
    )


def resample(path: NDArray[np.float64], spacing: float) -> NDArray[np.float64]:
    """Returns points of a polyline, evenly spaced by about `spacing` [m], ends included."""
    lengths = np.append(0.0, np.linalg.norm(np.diff(path, axis=0), axis=1).cumsum())
    if lengths[-1] == 0:
        return path[:1]
    desired = np.linspace(0, lengths[-1], max(round(lengths[-1] / spacing), 1) + 1)
    return np.stack([np.interp(desired, lengths, column) for column in path.T], axis=1)


RECIPE = "world.yaml"
_VERSION = 2
"""Of how meshes are drawn."""
_SAMPLES_PER_VOXEL_FACE = 8


@dataclass
class RenderedWorld:
    """The content of `world.yaml`, from which more of a captured world can be rendered."""

    # The mesh, absolute or relative to the capture.
    mesh: str = ""
    # The file or scenario that it was made from.
    origin: str = ""
    # How the capture was rendered.
    config: RenderConfig = field(default_factory=RenderConfig)
    # Split of scenes of the capture: train, validation or test.
    split: str = ""
    # Digest of the mesh's triangles, or of the generated world, see `splits.source_digest`.
    source_digest: list[str] = field(default_factory=list)
    # Of the way meshes were drawn.
    version: int = 1


def run(*, world: str | Path, out: str | Path, config: RenderConfig, seed: int = 0) -> None:
    """Renders a capture of a world to the folder `out`, as a TartanAir V1 sequence.

    Frames are collected in `.NAME.partial` next to `out`, where the same command resumes after an
    interruption. A complete capture is left as it is.

    Args:
        world: a mesh (.gltf, .glb or .obj), or a scenario whose world is procedural, one of the
            benchmark's ("P02") or a file (.yaml): that world, drawn from `seed`, is exported as
            `world.gltf` into the capture.

    Raises:
        ValueError, OSError: for a world or settings that cannot be rendered, a path through walls,
            something else in `out`, or a full disk.
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
    spec = None
    if world.suffix in (".yaml", ".yml"):
        scenario = load_config(Scenario(), world)
        if not is_procedural(scenario.world):
            raise ValueError(
                f"{world}: its world must be a generated one, got {type(scenario.world).__name__}"
            )
        spec = make_spec(scenario.world, seed)
        recipe = RenderedWorld("world.gltf", f"{world.name}, seed {seed}", config, version=_VERSION)
        described = f"{type(scenario.world).__name__} {seed}\n{dump_config(scenario.world)}"
        digests, found = part_digests([described.encode()]), _generated_split(scenario.world, seed)
    else:
        _check_mesh(world, config.up)
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
        esdf = mesh_distance(world, config.up, config.voxel_size)
    else:
        esdf = esdf_from_distance_field(spec.distance_field, config.voxel_size)
    X_WCs = _poses(esdf, config)
    with written_atomically(partial / RECIPE) as file:
        file.write_text(text)
    mesh = partial / recipe.mesh
    if spec is not None and not mesh.is_file():
        write_gltf(spec, mesh)
    view = _camera(mesh, config)
    _write_frames(partial, "rendering frames", X_WCs, view)
    for offset in config.offsets:
        moved = [move_left(X_WC, offset) for X_WC in X_WCs]
        free = [X_WC for X_WC in moved if _is_free(esdf, X_WC.translation(), config.clearance)]
        _write_frames(partial / f"offset_{offset:+.2f}", f"offset {offset:+.2f} m", free, view)
    if out.exists():
        out.rmdir()
    partial.rename(out)
    length = np.linalg.norm(np.diff([X.translation() for X in X_WCs], axis=0), axis=1).sum()
    print(f"{out}: {len(X_WCs)} frames of {config.width}x{config.height} along {length:.1f} m")


def true_camera(capture: Path) -> Callable[[RigidTransform], CaptureFrame] | None:
    """Returns a function that renders the world of a rendered capture at any pose X_WC, in the
    capture's camera; None if the capture was not rendered.

    Raises:
        ValueError, OSError: if its world is missing, damaged or cannot be rendered.
    """
    recipe = rendered_world(capture)
    if recipe is None:
        return None
    current, what = recipe.version == _VERSION, f"{capture / RECIPE}: version"
    require(current, what, f"{_VERSION}", recipe.version, "render it again")
    recipe.config.validate()
    return _camera(capture / recipe.mesh, recipe.config)


def _camera(mesh: Path, config: RenderConfig) -> Callable[[RigidTransform], CaptureFrame]:
    """Returns a function that renders a mesh with a camera as TartanAir's, 90 degrees wide."""
    renderer = MeshRenderer(mesh, config.up, config.background)
    width, height = config.width, config.height
    K = pinhole(width / 2, width / 2, width / 2, height / 2)
    return lambda X_WC: renderer.frame(X_WC, K, width, height)


def rendered_world(capture: Path) -> RenderedWorld | None:
    """Returns the world that a capture was rendered of; None if it was not rendered."""
    file = capture / RECIPE
    return load_config(RenderedWorld(), file) if file.is_file() else None


def _generated_split(world: WorldConfig, seed: int) -> str:
    """Returns the split of a generated world: that of its seed if the benchmark flies in it."""
    worlds = [load_config(Scenario(), file).world for file in benchmark_scenarios().values()]
    if world not in worlds:
        return "train"
    if seed < TRAINING_SEEDS:
        return "test"
    return "train" if seed < VALIDATION_SEEDS else "validation"


def mesh_digests(mesh: Path) -> set[str]:
    """Returns a digest of each triangle of a mesh, by its corners to a millimeter, independent of
    the file's format and materials."""
    try:
        surface = trimesh.load(mesh, force="mesh")
        area = surface.area if isinstance(surface, trimesh.Trimesh) else 0.0
    except Exception as error:  # trimesh raises anything of damaged files
        raise ValueError(
            f"{mesh}: not a readable mesh ({reason_of(error)}); export it again"
        ) from error
    if not isinstance(surface, trimesh.Trimesh) or not 0 < area < np.inf:
        raise ValueError(f"{mesh}: holds no surface; export it again")
    corners = np.round(surface.triangles * 1000).astype(np.int64)
    packed = corners @ np.array([1 << 42, 1 << 21, 1])  # (N, 3): one number per corner
    triangles = np.unique(np.sort(packed, axis=1), axis=0)
    return part_digests(triangle.tobytes() for triangle in triangles)


def mesh_distance(mesh: Path, up: str, voxel_size: float) -> Esdf:
    """Returns the distance to the surface of a mesh, from points sampled on it outside of holes."""
    with drawn_mesh(mesh, up) as drawn:
        p_WQ = drawn.sample(_SAMPLES_PER_VOXEL_FACE / voxel_size**2)
    if not len(p_WQ):
        raise ValueError(f"{mesh}: holds no surface; export it again")
    lower_W, upper_W = p_WQ.min(axis=0) - voxel_size, p_WQ.max(axis=0) + voxel_size
    try:
        grid_shape(lower_W, upper_W, voxel_size)
    except ValueError as error:
        raise ValueError(f"{mesh}: {error}") from None
    shape = np.ceil((upper_W - lower_W) / voxel_size).astype(int)
    occupied = np.zeros(shape, dtype=bool)
    occupied[tuple(((p_WQ - lower_W) / voxel_size).astype(int).T)] = True
    return esdf_from_occupancy(occupied, None, lower_W, voxel_size)


def _poses(esdf: Esdf, config: RenderConfig) -> list[RigidTransform]:
    """Returns the camera poses of the path, given or planned."""
    if config.path:
        X_WCs = poses_along(np.array(config.path), config.spacing, config.yaws, config.pitch)
        stops = np.array([X_WC.translation() for X_WC in X_WCs])
        for p_W in resample(stops, esdf.voxel_size / 2):
            if not _is_free(esdf, p_W, min(config.clearance, esdf.voxel_size)):
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
    rows = []
    for i, X_WC in enumerate(Progress(X_WCs, what, unit="frame")):
        R_FW = RigidTransform(AXES.R_WF.inverse())
        rows.append(f"{pose_row(R_FW @ X_WC @ RigidTransform(AXES.R_BC.inverse()))}\n")
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


_MAX_POINTS = 2_000_000
_MAX_GAUSSIANS = 200_000
_SPREAD = 0.6
"""Standard deviation of a Gaussian over the distance to its neighbors."""


def capture_gaussians(capture: Capture, frames: Sequence[int]) -> GaussianScene | None:
    """Returns round Gaussians at the measured depth of some frames or, without depth, at the points
    of the registration; None without either."""
    if capture.has_depth:
        points, colors = _points_from_depth(capture, frames)
    elif capture.points is not None:
        points, colors = capture.points.p_WQ, capture.points.colors
    else:
        return None
    if len(points) < 2:
        return None
    kept = _thinned(points, _MAX_GAUSSIANS)
    points, colors = points[kept], colors[kept]
    distances, _ = KDTree(points).query(points, k=2)
    # A point far from others is not larger than they are.
    size = np.minimum(distances[:, 1], 4 * np.median(distances[:, 1])) + 1e-6
    return GaussianScene.from_colors(
        points,
        np.tile([1.0, 0.0, 0.0, 0.0], (len(points), 1)),
        _SPREAD * size[:, None].repeat(3, axis=1),
        np.full(len(points), 0.95),
        colors,
    )


def _points_from_depth(
    capture: Capture, frames: Sequence[int]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Returns points p_WQ (N, 3) [m] and colors (N, 3), 0 to 1, of a grid of pixels."""
    pixels = len(frames) * capture.width * capture.height
    step = max(1, int(np.ceil(np.sqrt(pixels / _MAX_POINTS))))
    points, colors = [], []
    for i in Progress(frames, "reading depth", unit="frame", delay=2.0):
        frame = capture.frame(i)
        p_CQ, rows, columns = depth_points(frame.K, frame.depth, step)
        points.append(frame.X_WC.multiply(p_CQ.T).T)
        colors.append(frame.image[rows, columns] / 255)
    return np.concatenate(points), np.concatenate(colors)


def _thinned(points: NDArray[np.float64], count: int) -> NDArray[np.intp]:
    """Returns the first point in each cell of the finest grid of at most `count` occupied cells."""
    lower = points.min(axis=0)
    # Few points far away must not make the cells large.
    extent = float(np.percentile(np.ptp(points, axis=0), 50)) or 1.0
    edge = extent / 4096
    while True:
        cells = np.floor((points - lower) / edge).astype(np.int64)
        _, first = np.unique((cells[:, 0] << 42) ^ (cells[:, 1] << 21) ^ cells[:, 2], True)
        if len(first) <= count:
            return np.sort(first)
        edge *= 1.3
