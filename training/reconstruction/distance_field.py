"""The distance field of a reconstruction, fused from depth at the poses of the capture."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform

from splatpilot.systems.collision.depth_fusion import bounds_of_depth_images, esdf_from_depth_images
from splatpilot.systems.collision.esdf import Esdf
from splatpilot.systems.collision.observations import ConfirmedSurfaces
from splatpilot.systems.common.progress import Progress
from splatpilot.systems.splats.background import FAR
from splatpilot.systems.splats.scene import GaussianScene
from splatpilot.systems.vehicle.quadrotor import VEHICLE_RADIUS
from splatpilot.training.captures.capture import Capture, shrink_mask
from splatpilot.training.reconstruction.config import ReconstructConfig
from splatpilot.training.reconstruction.splat_rendering import SceneRenderer
from splatpilot.training.reconstruction.views import ShrunkFrames

_MEDIAN_DEPTH = 2.0  # [m], median depth of a capture without scale
_RANGE, _VOXEL_SIZE = 8.0, 0.05  # [m], minimum range, and voxels of rooms
_RANGE_OF_MEDIAN = 1.5  # range relative to the median depth
_VOXELS = 20e6  # maximum number, which a flight loads in seconds
_MEDIAN_IMAGES = 100  # maximum number of images that give the median


@dataclass(frozen=True)
class DepthSource:
    """Depth images (H, W) [m] with their poses, loaded one by one."""

    load: Callable[[int], NDArray[np.float32]]
    K: NDArray[np.float64]  # (3, 3) [px]
    X_WCs: Sequence[RigidTransform]

    def images(self, what: str = "") -> Iterable[NDArray[np.float32]]:
        """Loads all images, with a progress bar named `what` if given."""
        images = map(self.load, range(len(self.X_WCs)))
        return Progress(images, what, len(self.X_WCs), unit="image", delay=2.0) if what else images

    def median(self, far: float) -> float:
        """Returns the median depth [m] below `far` [m] of images along the path; 0 without any."""
        step = -(-len(self.X_WCs) // _MEDIAN_IMAGES)
        depths = [self.load(i)[::4, ::4] for i in range(0, len(self.X_WCs), step)]
        depth = np.concatenate([d[(d > 0) & (d < far)] for d in depths])
        return float(np.median(depth)) if len(depth) else 0.0


def captured_depth(capture: Capture, indices: Sequence[int]) -> DepthSource:
    """Returns the depth of some frames of a capture."""
    X_WCs = [capture.X_WCs[i] for i in indices]
    return DepthSource(lambda k: capture.registered_depth(indices[k]), capture.K, X_WCs)


def render_depth(
    capture: Capture, factor: int, gaussians: GaussianScene, representation: str, threads: int
) -> DepthSource:
    """Renders the median depth of the scene in the cameras of a capture, shrunk by an integer
    `factor`; 0 without a surface and in invalid pixels."""
    K = capture.K.copy()
    K[:2] /= factor
    width, height = capture.width // factor, capture.height // factor
    renderer = SceneRenderer(gaussians, representation, threads)

    def load(i: int) -> NDArray[np.float32]:
        valid = np.broadcast_to(capture.load_valid(i), (capture.height, capture.width))
        depth = renderer.render(K, width, height, capture.X_WCs[i]).depth
        return np.where(shrink_mask(valid, factor), depth, np.float32(0))

    return DepthSource(load, K, capture.X_WCs)


def add_sky(rendered: DepthSource, frames: ShrunkFrames) -> DepthSource:
    """Returns rendered depth, infinite where only the fitted frame's sky is, which frees space."""
    positions = {number: k for k, number in enumerate(frames.numbers)}

    def load(i: int) -> NDArray[np.float32]:
        depth = rendered.load(i)
        if i not in positions:
            return depth
        sky = (depth == 0) & (frames[positions[i]].depth >= FAR)
        return np.where(sky, np.float32(np.inf), depth)

    return replace(rendered, load=load)


def keep_confirmed(rendered: DepthSource, voxel_size: float) -> DepthSource:
    """Returns rendered depth that photographs determine, see `ConfirmedSurfaces`."""
    images = rendered.images("confirming surfaces")
    surfaces = ConfirmedSurfaces(images, rendered.K, rendered.X_WCs, voxel_size)

    def load(i: int) -> NDArray[np.float32]:
        return surfaces.keep(rendered.load(i), rendered.X_WCs[i])

    return replace(rendered, load=load)


@dataclass(frozen=True)
class FieldGrid:
    """The grid of a distance field, and the maximum depth that counts."""

    lower_W: NDArray[np.float64]  # (3,) [m]
    upper_W: NDArray[np.float64]  # (3,) [m]
    voxel_size: float  # [m]
    max_range: float  # [m]


def choose_grid(source: DepthSource, metric: bool, config: ReconstructConfig) -> FieldGrid:
    """Returns the grid that holds the depth images, by `ReconstructConfig`."""
    median = source.median(FAR if metric else np.inf)
    unit = 1.0 if metric else max(median, 1e-6) / _MEDIAN_DEPTH
    max_range = config.max_range * unit or max(_RANGE * unit, _RANGE_OF_MEDIAN * median)
    lower_W, upper_W = bounds_of_depth_images(source.images(), source.K, source.X_WCs, max_range)
    coarse = float(np.cbrt(np.prod(upper_W - lower_W) / _VOXELS))
    voxel_size = config.voxel_size * unit or max(_VOXEL_SIZE * unit, coarse)
    return FieldGrid(lower_W, upper_W, voxel_size, max_range)


def fuse(source: DepthSource, grid: FieldGrid, swept_radius: float = 0.0) -> Esdf:
    """Fuses depth images; unseen space is unknown except within `swept_radius` [m] of the path."""
    images = source.images()
    return esdf_from_depth_images(
        images, source.K, source.X_WCs, **vars(grid), swept_radius=swept_radius
    )


def make_distance_field(
    capture: Capture, frames: ShrunkFrames, gaussians: GaussianScene, config: ReconstructConfig
) -> tuple[Esdf, DepthSource]:
    """Makes the distance field of a reconstruction from its fitted frames and Gaussians; returns it
    with the captured depth or, without any, the rendered depth."""
    captured = captured_depth(capture, range(len(capture)))

    def fuse_within(source: DepthSource, bounds: DepthSource) -> Esdf:
        return fuse(source, choose_grid(bounds, capture.metric, config))

    if config.iterations == 0:
        return fuse_within(captured, captured), captured
    if capture.has_depth and config.distance_field == "captured":
        fitted = captured_depth(capture, frames.numbers)
        return fuse_within(fitted, fitted), captured
    rendered = render_depth(
        capture, frames.factor, gaussians, config.representation, config.renderer_threads
    )
    if not capture.has_depth:
        grid = choose_grid(rendered, capture.metric, config)
        confirmed = keep_confirmed(rendered, 2.0 * grid.voxel_size)
        images = confirmed.images()
        bounds = bounds_of_depth_images(images, confirmed.K, confirmed.X_WCs, grid.max_range)
        grid = replace(grid, lower_W=bounds[0], upper_W=bounds[1])
        # Depth that was not measured leaves gaps where the camera, and so the vehicle, has been.
        return fuse(confirmed, grid, VEHICLE_RADIUS if capture.metric else 0.0), confirmed
    return fuse_within(add_sky(rendered, frames), captured), captured
