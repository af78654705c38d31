"""The distance field of a reconstruction: from depth rendered at the poses of the capture."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from pydrake.math import RigidTransform

from splatpilot.systems.collision.distance_field import FieldState
from splatpilot.systems.collision.esdf import Esdf
from splatpilot.systems.collision.esdf_build import bounds_of_depth_images, esdf_from_depth_images
from splatpilot.systems.splats.background import FAR
from splatpilot.systems.splats.baked_scene import create_renderer
from splatpilot.systems.splats.scene import GaussianScene
from splatpilot.training.captures.capture import Capture, shrink_mask
from splatpilot.training.reconstruction.config import ReconstructConfig
from splatpilot.training.reconstruction.splat_rendering import render
from splatpilot.training.reconstruction.views import ShrunkFrames

# Fields are compared where the true one is at most this far from a surface [m].
_NEAR = 0.5
# The median depth of a scene of unknown scale is taken to be this [m].
_MEDIAN_DEPTH = 2.0
# What is not given: rooms have this range and these voxels [m], larger places multiples of their
# median depth, and as many voxels as a flight loads in seconds.
_RANGE, _VOXEL_SIZE = 8.0, 0.05
_RANGE_OF_MEDIAN = 1.5
_VOXELS = 20e6
# So many images are enough for the median of their depths.
_MEDIAN_IMAGES = 100


@dataclass(frozen=True)
class DepthSource:
    """Depth images (H, W) [m] with their poses, loaded one by one and as often as wanted."""

    load: Callable[[int], NDArray[np.float32]]
    K: NDArray[np.float64]  # (3, 3) [px]
    X_WCs: Sequence[RigidTransform]

    def images(self) -> Iterator[NDArray[np.float32]]:
        return (self.load(i) for i in range(len(self.X_WCs)))

    def median(self, far: float) -> float:
        """[m], of what is nearer than `far` [m] in images all along the path; 0 if nothing is."""
        step = -(-len(self.X_WCs) // _MEDIAN_IMAGES)
        depths = [self.load(i)[::4, ::4] for i in range(0, len(self.X_WCs), step)]
        depth = np.concatenate([d[(d > 0) & (d < far)] for d in depths])
        return float(np.median(depth)) if len(depth) else 0.0


def render_depth(
    gaussians: GaussianScene,
    representation: str,
    K: NDArray[np.float64],
    width: int,
    height: int,
    X_WCs: Sequence[RigidTransform],
    threads: int,
) -> DepthSource:
    """Returns what cameras would measure in the scene: median depth, 0 where no surface is."""
    tensors = tuple(
        torch.from_numpy(getattr(gaussians, name))
        for name in ("means", "quats", "scales", "opacities", "sh")
    )
    renderer = create_renderer(threads)

    def load(i: int) -> NDArray[np.float32]:
        viewmat = torch.from_numpy(X_WCs[i].inverse().GetAsMatrix4()).float()[None]
        with torch.no_grad():
            rendering = render(
                representation,
                tensors,  # pyright: ignore[reportArgumentType]
                viewmat,
                torch.from_numpy(K).float()[None],
                width,
                height,
                depth_mode="MD",
                renderer=renderer,
            )
        return rendering.depth.numpy()

    return DepthSource(load, K, X_WCs)


def render_depth_of(
    capture: Capture, factor: int, gaussians: GaussianScene, representation: str, threads: int
) -> DepthSource:
    """Returns what the cameras of a capture would measure in the scene, see `render_depth`, in
    images shrunken by a whole `factor`; nothing in pixels of which some is invalid."""
    K = capture.K.copy()
    K[:2] /= factor
    width, height = capture.width // factor, capture.height // factor
    rendered = render_depth(gaussians, representation, K, width, height, capture.X_WCs, threads)

    def load(i: int) -> NDArray[np.float32]:
        valid = np.broadcast_to(capture.load_valid(i), (capture.height, capture.width))
        return np.where(shrink_mask(valid, factor), rendered.load(i), np.float32(0))

    return DepthSource(load, K, capture.X_WCs)


def add_sky(rendered: DepthSource, frames: ShrunkFrames) -> DepthSource:
    """Returns rendered depth that is infinite where nothing is rendered and the frame of the same
    number shows the infinitely far: there the space before the sky was seen to be free."""
    places = {number: k for k, number in enumerate(frames.numbers)}

    def load(i: int) -> NDArray[np.float32]:
        depth = rendered.load(i)
        if i not in places:
            return depth
        return np.where((depth == 0) & (frames[places[i]].depth >= FAR), np.float32(np.inf), depth)

    return DepthSource(load, rendered.K, rendered.X_WCs)


@dataclass(frozen=True)
class FieldGrid:
    """The grid of a distance field, and how far depth is believed."""

    lower_W: NDArray[np.float64]  # (3,) [m]
    upper_W: NDArray[np.float64]  # (3,) [m]
    voxel_size: float  # [m]
    max_range: float  # [m]


def choose_grid(source: DepthSource, metric: bool, config: ReconstructConfig) -> FieldGrid:
    """Returns the grid that holds what depth images show, as fine and as far as the config says or,
    where it says nothing, as suits the place. Lengths of the config are metres, or those of a place
    whose median depth is `_MEDIAN_DEPTH` where the scale is unknown."""
    median = source.median(FAR if metric else np.inf)
    unit = 1.0 if metric else max(median, 1e-6) / _MEDIAN_DEPTH
    max_range = config.max_range * unit or max(_RANGE * unit, _RANGE_OF_MEDIAN * median)
    lower_W, upper_W = bounds_of_depth_images(source.images(), source.K, source.X_WCs, max_range)
    coarse = float(np.cbrt(np.prod(upper_W - lower_W) / _VOXELS))
    voxel_size = config.voxel_size * unit or max(_VOXEL_SIZE * unit, coarse)
    return FieldGrid(lower_W, upper_W, voxel_size, max_range)


def fuse(source: DepthSource, grid: FieldGrid) -> Esdf:
    """Fuses depth images into a distance field; space that no image saw is marked unknown."""
    return esdf_from_depth_images(
        source.images(),
        source.K,
        source.X_WCs,
        grid.lower_W,
        grid.upper_W,
        grid.voxel_size,
        grid.max_range,
    )


@dataclass(frozen=True)
class FieldDifference:
    """How a distance field differs from the true one, near surfaces and where both are known."""

    mean: float  # [m], positive: surfaces seem farther than they are
    median_absolute: float  # [m]
    p95_absolute: float  # [m]
    blocked: float  # fraction of space that is free by a voxel or more, but counts as occupied
    opened: float  # fraction of space that is occupied, but counts as free by a voxel or more

    def __str__(self) -> str:
        return (
            f"{self.mean:+.3f} m mean, {self.median_absolute:.3f} m median, "
            f"{self.p95_absolute:.3f} m 95th percentile; free taken as occupied "
            f"{100 * self.blocked:.2f} %, occupied as free {100 * self.opened:.2f} %"
        )


def compare_fields(field: Esdf, truth: Esdf) -> FieldDifference | None:
    """Compares two fields on the same grid; None if nothing near a surface is known in both."""
    d, d_true = field.distances, truth.distances
    known = (field.states != FieldState.UNKNOWN) & (truth.states != FieldState.UNKNOWN)
    free = known & (d_true > truth.voxel_size)
    occupied = known & (truth.states == FieldState.OCCUPIED)
    near = known & (np.abs(d_true) < _NEAR)
    if not near.any():
        return None
    error = (d - d_true)[near]
    return FieldDifference(
        mean=float(error.mean()),
        median_absolute=float(np.median(np.abs(error))),
        p95_absolute=float(np.percentile(np.abs(error), 95)),
        blocked=float((field.states == FieldState.OCCUPIED)[free].mean()),
        opened=float((d[occupied] > field.voxel_size).mean()),
    )


def make_distance_field(
    capture: Capture, frames: ShrunkFrames, gaussians: GaussianScene, config: ReconstructConfig
) -> tuple[Esdf, FieldDifference | None, DepthSource]:
    """Returns the distance field of a reconstruction, from depth rendered or captured; if the
    capture has depth and was optimised, how the former differs from that of all captured depth;
    and all depth that is known best: captured or, without any, rendered.

    Args:
        capture: what was seen.
        frames: those of its frames that were fitted, as small as they were for that.
        gaussians: what came of it.
        config: how.
    """
    every = DepthSource(capture.registered_depth, capture.K, capture.X_WCs)
    if config.iterations == 0:
        return fuse(every, choose_grid(every, capture.metric, config)), None, every
    rendered = render_depth_of(
        capture, frames.factor, gaussians, config.representation, config.renderer_threads
    )
    if not capture.has_depth:
        return fuse(rendered, choose_grid(rendered, capture.metric, config)), None, rendered
    grid = choose_grid(every, capture.metric, config)
    truth = fuse(every, grid)
    field = fuse(add_sky(rendered, frames), grid)
    difference = compare_fields(field, truth)
    if config.distance_field == "rendered":
        return field, difference, every
    seen = DepthSource(
        lambda k: capture.registered_depth(frames.numbers[k]),
        capture.K,
        [capture.X_WCs[i] for i in frames.numbers],
    )
    return fuse(seen, choose_grid(seen, capture.metric, config)), difference, every
