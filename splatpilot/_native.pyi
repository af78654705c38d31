"""Splat kernels for CPUs."""

from collections.abc import Sequence
import enum
from typing import Annotated

import numpy
from numpy.typing import NDArray


def simd_levels() -> list[str]:
    """SIMD levels that this machine can run, widest first."""

class DepthMode(enum.Enum):
    """Depth of a pixel."""

    ACCUMULATED = 0
    """sum w z"""

    EXPECTED = 1
    """sum w z / sum w"""

    MEDIAN = 2
    """
    z where the transmittance of footprints without blur falls below one half, else 0
    """

class Renderer:
    """Threads and scratch memory without influence on images."""

    def __init__(self, threads: int, simd: str = '') -> None: ...

    @property
    def simd(self) -> str: ...

class Gaussians:
    """Gaussians or surfels; colors are (N, K, 3)."""

    def __init__(self, *, means: Annotated[NDArray[numpy.float32], dict(shape=(None, 3), order='C', device='cpu', writable=False)], quats: Annotated[NDArray[numpy.float32], dict(shape=(None, 4), order='C', device='cpu', writable=False)], scales: Annotated[NDArray[numpy.float32], dict(shape=(None, 3), order='C', device='cpu', writable=False)], opacities: Annotated[NDArray[numpy.float32], dict(shape=(None,), order='C', device='cpu', writable=False)], colors: Annotated[NDArray[numpy.float32], dict(shape=(None, None, 3), order='C', device='cpu', writable=False)], sh_degree: int) -> None:
        """sh_degree -1: colors are given, K = 1."""

    def are_valid(self, renderer: Renderer) -> bool:
        """Checks that every number can be rendered; subnormal scales may fail."""

class GaussianGradients:
    """Gradients of `Gaussians`, to be added to."""

    def __init__(self, *, means: Annotated[NDArray[numpy.float32], dict(shape=(None, 3), order='C', device='cpu')], quats: Annotated[NDArray[numpy.float32], dict(shape=(None, 4), order='C', device='cpu')], scales: Annotated[NDArray[numpy.float32], dict(shape=(None, 3), order='C', device='cpu')], opacities: Annotated[NDArray[numpy.float32], dict(shape=(None,), order='C', device='cpu')], colors: Annotated[NDArray[numpy.float32], dict(shape=(None, None, 3), order='C', device='cpu')], overwrite: bool, overwrite_colors: bool) -> None:
        """Those to overwrite need no values."""

class Camera:
    """A pinhole camera or one with a lens."""

    def __init__(self, *, K: Annotated[NDArray[numpy.float64], dict(shape=(3, 3), order='C', device='cpu', writable=False)], X_CW: Annotated[NDArray[numpy.float64], dict(shape=(4, 4), order='C', device='cpu', writable=False)], width: int, height: int, near_plane: float, far_plane: float, radius_clip: float = 0.0, eps2d: float = 0.0, antialiased: bool = False, max_depth: float = float('inf'), merged_spread: float = 0.0, rows_above: int = 0, rows_below: int = 0, distortion: int = 0, lens: Annotated[NDArray[numpy.float64], dict(shape=(17), order='C', device='cpu', writable=False)] | None = None) -> None: ...

class Frame:
    """A rendered image, for its backward pass."""

    @property
    def splat_count(self) -> int:
        """Number of visible Gaussians."""

def projected(renderer: Renderer, frame: Frame, opacities: Annotated[NDArray[numpy.float32], dict(shape=(None,), order='C', device='cpu', writable=False)] | None) -> tuple[Annotated[NDArray[numpy.int64], dict(shape=(None,))], Annotated[NDArray[numpy.int32], dict(shape=(None, 2))], Annotated[NDArray[numpy.float32], dict(shape=(None, 2))], Annotated[NDArray[numpy.float32], dict(shape=(None,))], Annotated[NDArray[numpy.float32], dict(shape=(None, 3))], Annotated[NDArray[numpy.float32], dict(shape=(None,))]]:
    """
    ids (n,), radii (n, 2), means (n, 2), depths (n,), conics (n, 3) and opacities (n,) of
    a frame's splats.
    """

def render(renderer: Renderer, gaussians: Gaussians, camera: Camera, *, depth_mode: DepthMode, background: Annotated[NDArray[numpy.float32], dict(shape=(3), order='C', device='cpu', writable=False)], image: Annotated[NDArray[numpy.float32], dict(shape=(None, None, None), order='C', device='cpu')], alpha: Annotated[NDArray[numpy.float32], dict(shape=(None, None, None), order='C', device='cpu')], keep: bool) -> Frame:
    """
    Writes color (3 channels), depth (1) or both (4) by the shape of image, and alpha. With
    keep, a backward pass can start from the frame.
    """

def raster_backward(renderer: Renderer, frame: Frame, *, v_image: Annotated[NDArray[numpy.float32], dict(shape=(None, None, None), order='C', device='cpu', writable=False)], v_alpha: Annotated[NDArray[numpy.float32], dict(shape=(None, None, None), order='C', device='cpu', writable=False)], image: Annotated[NDArray[numpy.float32], dict(shape=(None, None, None), order='C', device='cpu', writable=False)], alpha: Annotated[NDArray[numpy.float32], dict(shape=(None, None, None), order='C', device='cpu', writable=False)], background: Annotated[NDArray[numpy.float32], dict(shape=(3), order='C', device='cpu', writable=False)], expected_depth: bool, v_splats: Annotated[NDArray[numpy.float32], dict(shape=(None, 16), order='C', device='cpu')], v_means2d: Annotated[NDArray[numpy.float32], dict(shape=(None, 2), order='C', device='cpu')]) -> None:
    """
    Writes the gradients of a frame's splats. v_image etc. are derivatives of the loss by
    image etc.
    """

def project_backward(renderer: Renderer, frame: Frame, gaussians: Gaussians, gradients: GaussianGradients, *, v_splats: Annotated[NDArray[numpy.float32], dict(shape=(None, 16), order='C', device='cpu', writable=False)], v_means2d: Annotated[NDArray[numpy.float32], dict(shape=(None, 2), order='C', device='cpu', writable=False)]) -> Annotated[NDArray[numpy.float64], dict(shape=(5, 3))]:
    """
    Writes the gradients of the frame's Gaussians. Returns (5, 3) those by R_CW with the
    camera's center fixed, by p_C and by p_W - center, summed over Gaussians.
    """

class BakedScene:
    """A static scene in the order and form of frames."""

    def __init__(self, gaussians: Gaussians) -> None: ...

    @property
    def count(self) -> int: ...

    def merge_neighbors(self) -> None:
        """Prepares images of cameras with a merged_spread."""

    def recolored(self, sh: Annotated[NDArray[numpy.float32], dict(shape=(None, None, 3), order='C', device='cpu', writable=False)], sh_degree: int) -> BakedScene:
        """The same Gaussians in other colors."""

def render_baked(scene: BakedScene, renderer: Renderer, moving: Gaussians, camera: Camera, *, background: Annotated[NDArray[numpy.float32], dict(shape=(3), order='C', device='cpu', writable=False)], color: Annotated[NDArray[numpy.float32], dict(shape=(None, None, None), order='C', device='cpu')] | None, depth: Annotated[NDArray[numpy.float32], dict(shape=(None, None, None), order='C', device='cpu')] | None, alpha: Annotated[NDArray[numpy.float32], dict(shape=(None, None, None), order='C', device='cpu')] | None) -> None:
    """
    Writes the median depth, color and alpha, unless they are None, of the scene and of moving
    Gaussians among it.
    """

class BatchRenderer:
    """Threads that render one image each."""

    def __init__(self, threads: int, simd: str = '') -> None: ...

def render_views(renderer: BatchRenderer, scenes: Sequence[BakedScene], cameras: Sequence[Camera], *, backgrounds: Annotated[NDArray[numpy.float32], dict(shape=(None, 3), order='C', device='cpu', writable=False)], color: Annotated[NDArray[numpy.float32], dict(shape=(None, None, None, None), order='C', device='cpu')] | None, depth: Annotated[NDArray[numpy.float32], dict(shape=(None, None, None, None), order='C', device='cpu')] | None, alpha: Annotated[NDArray[numpy.float32], dict(shape=(None, None, None, None), order='C', device='cpu')] | None) -> None:
    """
    Writes the images of N cameras as render_baked does, camera i in scene i.
    """

class SurfelFrame:
    """A rendered image of surfels."""

def render_surfels(renderer: Renderer, surfels: Gaussians, camera: Camera, *, color: Annotated[NDArray[numpy.float32], dict(shape=(None, None, None), order='C', device='cpu')], normal: Annotated[NDArray[numpy.float32], dict(shape=(None, None, None), order='C', device='cpu')], depth: Annotated[NDArray[numpy.float32], dict(shape=(None, None, None), order='C', device='cpu')], alpha: Annotated[NDArray[numpy.float32], dict(shape=(None, None, None), order='C', device='cpu')], median: Annotated[NDArray[numpy.float32], dict(shape=(None, None, None), order='C', device='cpu')], distort: Annotated[NDArray[numpy.float32], dict(shape=(None, None, None), order='C', device='cpu')] | None, keep: bool) -> SurfelFrame:
    """Writes images; with keep, a backward pass can start from the frame."""

def surfels_backward(renderer: Renderer, frame: SurfelFrame, surfels: Gaussians, gradients: GaussianGradients, *, v_color: Annotated[NDArray[numpy.float32], dict(shape=(None, None, None), order='C', device='cpu', writable=False)] | None, v_normal: Annotated[NDArray[numpy.float32], dict(shape=(None, None, None), order='C', device='cpu', writable=False)] | None, v_depth: Annotated[NDArray[numpy.float32], dict(shape=(None, None, None), order='C', device='cpu', writable=False)] | None, v_alpha: Annotated[NDArray[numpy.float32], dict(shape=(None, None, None), order='C', device='cpu', writable=False)] | None, v_median: Annotated[NDArray[numpy.float32], dict(shape=(None, None, None), order='C', device='cpu', writable=False)] | None, v_distort: Annotated[NDArray[numpy.float32], dict(shape=(None, None, None), order='C', device='cpu', writable=False)] | None) -> Annotated[NDArray[numpy.float64], dict(shape=(5, 3))]:
    """
    Writes the gradients of the frame's surfels; returns as project_backward.
    """

def projected_surfels(renderer: Renderer, frame: SurfelFrame) -> tuple[Annotated[NDArray[numpy.int64], dict(shape=(None,))], Annotated[NDArray[numpy.int32], dict(shape=(None, 2))], Annotated[NDArray[numpy.float32], dict(shape=(None, 2))], Annotated[NDArray[numpy.float32], dict(shape=(None,))], Annotated[NDArray[numpy.float32], dict(shape=(None, 3))]]:
    """
    ids (n,), radii (n, 2), means (n, 2), depths (n,) and normals in the world (n, 3) of a
    frame's surfels, in the order of the input.
    """

def splat_shapes(*, log_scales: Annotated[NDArray[numpy.float32], dict(shape=(None, 3), order='C', device='cpu', writable=False)], logit_opacities: Annotated[NDArray[numpy.float32], dict(shape=(None,), order='C', device='cpu', writable=False)], smallest: Annotated[NDArray[numpy.float32], dict(shape=(None,), order='C', device='cpu', writable=False)], scales: Annotated[NDArray[numpy.float32], dict(shape=(None, 3), order='C', device='cpu')], opacities: Annotated[NDArray[numpy.float32], dict(shape=(None,), order='C', device='cpu')], simd: str = '') -> None:
    """
    Writes sqrt(exp(2 log_scales) + smallest^2) and sigmoid(logit_opacities).
    """

def splat_shapes_backward(*, scales: Annotated[NDArray[numpy.float32], dict(shape=(None, 3), order='C', device='cpu', writable=False)], opacities: Annotated[NDArray[numpy.float32], dict(shape=(None,), order='C', device='cpu', writable=False)], smallest: Annotated[NDArray[numpy.float32], dict(shape=(None,), order='C', device='cpu', writable=False)], v_scales: Annotated[NDArray[numpy.float32], dict(shape=(None, 3), order='C', device='cpu', writable=False)], v_opacities: Annotated[NDArray[numpy.float32], dict(shape=(None,), order='C', device='cpu', writable=False)], v_log_scales: Annotated[NDArray[numpy.float32], dict(shape=(None, 3), order='C', device='cpu')], v_logit_opacities: Annotated[NDArray[numpy.float32], dict(shape=(None,), order='C', device='cpu')], simd: str = '') -> None:
    """Writes the gradients of the inputs of splat_shapes."""

def surface_loss(*, means: Annotated[NDArray[numpy.float32], dict(shape=(None, 3), order='C', device='cpu', writable=False)], quats: Annotated[NDArray[numpy.float32], dict(shape=(None, 4), order='C', device='cpu', writable=False)], scales: Annotated[NDArray[numpy.float32], dict(shape=(None, 3), order='C', device='cpu', writable=False)], seen: Annotated[NDArray[numpy.int64], dict(shape=(None,), order='C', device='cpu', writable=False)], draws: Annotated[NDArray[numpy.float32], dict(shape=(None, 3), order='C', device='cpu', writable=False)], X_CW: Annotated[NDArray[numpy.float32], dict(shape=(4, 4), order='C', device='cpu', writable=False)], K: Annotated[NDArray[numpy.float32], dict(shape=(3, 3), order='C', device='cpu', writable=False)], depth: Annotated[NDArray[numpy.float32], dict(shape=(None, None), order='C', device='cpu', writable=False)], reach: float, nearest: float, far: float, v_means: Annotated[NDArray[numpy.float32], dict(shape=(None, 3), order='C', device='cpu')], v_quats: Annotated[NDArray[numpy.float32], dict(shape=(None, 4), order='C', device='cpu')], v_scales: Annotated[NDArray[numpy.float32], dict(shape=(None, 3), order='C', device='cpu')]) -> float:
    """
    Mean |log(z / depth)| of points drawn from visible Gaussians; adds gradients.
    """

def photometric_loss(*, rendered: Annotated[NDArray[numpy.float32], dict(shape=(None, None, None, None), order='C', device='cpu', writable=False)], target: Annotated[NDArray[numpy.float32], dict(shape=(None, None, None, None), order='C', device='cpu', writable=False)], ssim_weight: float, gradient: Annotated[NDArray[numpy.float32], dict(shape=(None, None, None, None), order='C', device='cpu')] | None, simd: str = '') -> float:
    """
    (1 - w) L1 + w (1 - SSIM) of images (N, H, W, C); writes the gradient unless None.
    """

def log_depth_loss(*, rendered: Annotated[NDArray[numpy.float32], dict(shape=(None,), order='C', device='cpu', writable=False)], depth: Annotated[NDArray[numpy.float32], dict(shape=(None,), order='C', device='cpu', writable=False)], weights: Annotated[NDArray[numpy.float32], dict(shape=(None,), order='C', device='cpu', writable=False)] | None, epsilon: float, far: float, gradient: Annotated[NDArray[numpy.float32], dict(shape=(None,), order='C', device='cpu')] | None, simd: str = '') -> float:
    """
    Mean weighted |log(rendered / depth)| over valid pixels; writes the gradient unless None.
    """

class ShapeWorlds:
    """The analytic shapes of several worlds."""

    def __init__(self, *, shapes: Annotated[NDArray[numpy.float32], dict(shape=(None, 15), order='C', device='cpu', writable=False)], kinds: Annotated[NDArray[numpy.uint8], dict(shape=(None,), order='C', device='cpu', writable=False)], first: Annotated[NDArray[numpy.int64], dict(shape=(None,), order='C', device='cpu', writable=False)], threads: int = 1, simd: str = '') -> None:
        """
        World w has the rows first[w] to first[w + 1]. A row holds, by its kind: 0 center and
        radius of a sphere; 1 end, axis, length and radius of a capsule; 2 center, axis, half
        length and radius of a cylinder; 3 center, rotation and half sizes of a box; 4 normal
        and offset of a half space.
        """

    def __len__(self) -> int: ...

    def depth(self, *, p_WC: Annotated[NDArray[numpy.float32], dict(shape=(None, 3), order='C', device='cpu', writable=False)], R_WC: Annotated[NDArray[numpy.float32], dict(shape=(None, 3, 3), order='C', device='cpu', writable=False)], world: Annotated[NDArray[numpy.int64], dict(shape=(None,), order='C', device='cpu', writable=False)], directions_C: Annotated[NDArray[numpy.float32], dict(shape=(None, 3), order='C', device='cpu', writable=False)], half_pixel: float, depth: Annotated[NDArray[numpy.float32], dict(shape=(None, None), order='C', device='cpu')]) -> None:
        """Writes the depth images of N cameras."""

    def nearest(self, *, p_WQ: Annotated[NDArray[numpy.float32], dict(shape=(None, 3), order='C', device='cpu', writable=False)], world: Annotated[NDArray[numpy.int64], dict(shape=(None,), order='C', device='cpu', writable=False)], values: Annotated[NDArray[numpy.float32], dict(shape=(None, None), order='C', device='cpu')], gradients: Annotated[NDArray[numpy.float32], dict(shape=(None, None, None), order='C', device='cpu')]) -> None:
        """
        Writes the distances (N, K) of the K nearest shapes and their gradients (N, K, 3).
        """

class ShapeField:
    """The distance field of analytic shapes."""

    def __init__(self, *, shapes: Annotated[NDArray[numpy.float64], dict(shape=(None, 15), order='C', device='cpu', writable=False)], kinds: Annotated[NDArray[numpy.uint8], dict(shape=(None,), order='C', device='cpu', writable=False)]) -> None:
        """Rows and kinds as of `ShapeWorlds`."""

    def nearest(self, *, p_WQ: Annotated[NDArray[numpy.float64], dict(shape=(None, 3), order='C', device='cpu', writable=False)], distances: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu')], gradients: Annotated[NDArray[numpy.float64], dict(shape=(None, 3), order='C', device='cpu')] | None = None) -> None:
        """
        Writes the signed distances (N,) of N points to the nearest shape and their gradients
        (N, 3); infinite and zero without shapes.
        """

class GridWorlds:
    """Regular grids, one per world."""

    def __init__(self, *, values: Annotated[NDArray[numpy.float32], dict(shape=(None,), order='C', device='cpu', writable=False)], shapes: Annotated[NDArray[numpy.int64], dict(shape=(None, 3), order='C', device='cpu', writable=False)], lower_W: Annotated[NDArray[numpy.float32], dict(shape=(None, 3), order='C', device='cpu', writable=False)], voxel_sizes: Annotated[NDArray[numpy.float32], dict(shape=(None,), order='C', device='cpu', writable=False)], threads: int = 1, simd: str = '') -> None:
        """The values of all grids, one after another."""

    def __len__(self) -> int: ...

    def depth(self, *, p_WC: Annotated[NDArray[numpy.float32], dict(shape=(None, 3), order='C', device='cpu', writable=False)], R_WC: Annotated[NDArray[numpy.float32], dict(shape=(None, 3, 3), order='C', device='cpu', writable=False)], world: Annotated[NDArray[numpy.int64], dict(shape=(None,), order='C', device='cpu', writable=False)], directions_C: Annotated[NDArray[numpy.float32], dict(shape=(None, 3), order='C', device='cpu', writable=False)], half_pixel: float, depth: Annotated[NDArray[numpy.float32], dict(shape=(None, None), order='C', device='cpu')]) -> None:
        """
        Writes the depth images of N cameras where the values are signed distances.
        """

    def interpolate(self, *, p_WQ: Annotated[NDArray[numpy.float32], dict(shape=(None, 3), order='C', device='cpu', writable=False)], world: Annotated[NDArray[numpy.int64], dict(shape=(None,), order='C', device='cpu', writable=False)], values: Annotated[NDArray[numpy.float32], dict(shape=(None,), order='C', device='cpu')], gradients: Annotated[NDArray[numpy.float32], dict(shape=(None, 3), order='C', device='cpu')]) -> None:
        """Writes the trilinear interpolants (N,) and their gradients (N, 3)."""

def grid_distances(*, grid: Annotated[NDArray[numpy.float32], dict(shape=(None, None, None), order='C', device='cpu', writable=False)], lower_W: Annotated[NDArray[numpy.float64], dict(shape=(3), order='C', device='cpu', writable=False)], upper_W: Annotated[NDArray[numpy.float64], dict(shape=(3), order='C', device='cpu', writable=False)], voxel_size: float, occupied_outside: bool, p_WQ: Annotated[NDArray[numpy.float64], dict(shape=(None, 3), order='C', device='cpu', writable=False)], distances: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu')], gradients: Annotated[NDArray[numpy.float64], dict(shape=(None, 3), order='C', device='cpu')] | None = None) -> None:
    """
    Writes the distances (N,) at N points and their gradients (N, 3): between the centers of
    voxels the trilinear interpolant of the grid; outside, minus the distance to the box, or
    NaN with a gradient of zero.
    """

def travel_times(*, front: Annotated[NDArray[numpy.float64], dict(shape=(None, None, None), order='C', device='cpu', writable=False)], speed: Annotated[NDArray[numpy.float64], dict(shape=(None, None, None), order='C', device='cpu', writable=False)], blocked: Annotated[NDArray[numpy.bool_], dict(shape=(None, None, None), order='C', device='cpu', writable=False)], voxel_size: float, times: Annotated[NDArray[numpy.float64], dict(shape=(None, None, None), order='C', device='cpu')]) -> None:
    """
    Writes the times at which a front from the zeros of the distances `front` arrives at each
    voxel, at most at `speed` and around blocked voxels; infinity where it does not arrive.
    """

def descend(*, times: Annotated[NDArray[numpy.float32], dict(shape=(None, None, None), order='C', device='cpu', writable=False)], lower_W: Annotated[NDArray[numpy.float64], dict(shape=(3), order='C', device='cpu', writable=False)], voxel_size: float, p_WG: Annotated[NDArray[numpy.float64], dict(shape=(3), order='C', device='cpu', writable=False)], p_WQ: Annotated[NDArray[numpy.float64], dict(shape=(3), order='C', device='cpu', writable=False)], step: float, length: float, path: Annotated[NDArray[numpy.float64], dict(shape=(None, 4), order='C', device='cpu')]) -> int:
    """
    Writes points and the length up to them, rows (4,), down the gradient of `times` from
    p_WQ to p_WG or until `length` is covered; returns their number.
    """

FLIGHT_PARAMETERS: list = ...

class FlightWorlds:
    """The distance fields of worlds."""

    def __init__(self) -> None: ...

    def __len__(self) -> int: ...

    def add_shapes(self, *, shapes: Annotated[NDArray[numpy.float64], dict(shape=(None, 15), order='C', device='cpu', writable=False)], kinds: Annotated[NDArray[numpy.uint8], dict(shape=(None,), order='C', device='cpu', writable=False)], lower_W: Annotated[NDArray[numpy.float64], dict(shape=(3), order='C', device='cpu', writable=False)], upper_W: Annotated[NDArray[numpy.float64], dict(shape=(3), order='C', device='cpu', writable=False)]) -> int:
        """
        Adds a world of analytic shapes, see `ShapeWorlds`; returns its number.
        """

    def add_grid(self, *, distances: Annotated[NDArray[numpy.float32], dict(shape=(None, None, None), order='C', device='cpu', writable=False)], states: Annotated[NDArray[numpy.uint8], dict(shape=(None, None, None), order='C', device='cpu', writable=False)], lower_W: Annotated[NDArray[numpy.float64], dict(shape=(3), order='C', device='cpu', writable=False)], upper_W: Annotated[NDArray[numpy.float64], dict(shape=(3), order='C', device='cpu', writable=False)], voxel_size: float, occupied_outside: bool) -> int:
        """Adds a world of a grid, see `grid_distances`; returns its number."""

    def query(self, *, p_WQ: Annotated[NDArray[numpy.float64], dict(shape=(None, 3), order='C', device='cpu', writable=False)], world: Annotated[NDArray[numpy.int64], dict(shape=(None,), order='C', device='cpu', writable=False)], distances: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu')], states: Annotated[NDArray[numpy.uint8], dict(shape=(None,), order='C', device='cpu')], gradients: Annotated[NDArray[numpy.float64], dict(shape=(None, 3), order='C', device='cpu')] | None = None) -> None:
        """
        Writes the distances (N,), their gradients (N, 3) and the states of space (N,).
        """

class Vehicles:
    """
    Arrays of N vehicles, which `FlightThreads` updates. Parameters are in packs
    (ceil(N / 16), len(FLIGHT_PARAMETERS), 16).
    """

    def __init__(self, *, states: Annotated[NDArray[numpy.float64], dict(shape=(None, 13), order='C', device='cpu')], thrusts: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu')], parameters: Annotated[NDArray[numpy.float64], dict(shape=(None, 30, 16), order='C', device='cpu', writable=False)], world: Annotated[NDArray[numpy.int64], dict(shape=(None,), order='C', device='cpu', writable=False)], goals: Annotated[NDArray[numpy.float64], dict(shape=(None, 3), order='C', device='cpu', writable=False)], radii: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu', writable=False)], goal_radii: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu', writable=False)], remaining: Annotated[NDArray[numpy.int32], dict(shape=(None,), order='C', device='cpu')], distances: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu')], field_states: Annotated[NDArray[numpy.uint8], dict(shape=(None,), order='C', device='cpu')], ends: Annotated[NDArray[numpy.uint8], dict(shape=(None,), order='C', device='cpu')]) -> None: ...

class FlightThreads:
    """Threads without influence on flights."""

    def __init__(self, threads: int, simd: str = '') -> None: ...

    def advance(self, worlds: FlightWorlds, vehicles: Vehicles, *, kind: str, actions: Annotated[NDArray[numpy.float64], dict(shape=(None, None), order='C', device='cpu', writable=False)], earlier: Annotated[NDArray[numpy.float64], dict(shape=(None, None), order='C', device='cpu', writable=False)], delays: Annotated[NDArray[numpy.int32], dict(shape=(None,), order='C', device='cpu')], flying: Annotated[NDArray[numpy.bool_], dict(shape=(None,), order='C', device='cpu', writable=False)], actuated: bool, periods: int, step: float, steps: int) -> None:
        """
        Flies vehicles for periods of their controllers, each of `steps` steps [s], until one
        ends: 1 collision, 2 left volume, 3 goal, 4 timeout. An action follows the earlier one
        after its delay [periods].
        """

def flight_command(kind: str, state: Annotated[NDArray[numpy.float64], dict(shape=(13), order='C', device='cpu', writable=False)], action: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu', writable=False)], parameters: Annotated[NDArray[numpy.float64], dict(shape=(30), order='C', device='cpu', writable=False)], command: Annotated[NDArray[numpy.float64], dict(shape=(4), order='C', device='cpu')]) -> None:
    """
    Writes the command (4,) of the controller, for parameters in the order of
    FLIGHT_PARAMETERS.
    """

def quadrotor_derivatives(state: Annotated[NDArray[numpy.float64], dict(shape=(13), order='C', device='cpu', writable=False)], command: Annotated[NDArray[numpy.float64], dict(shape=(4), order='C', device='cpu', writable=False)], drag: float, rate_time_constant: float, gravity: float, derivatives: Annotated[NDArray[numpy.float64], dict(shape=(13), order='C', device='cpu')], wind: Annotated[NDArray[numpy.float64], dict(shape=(3), order='C', device='cpu', writable=False)] | None = None, disturbance: Annotated[NDArray[numpy.float64], dict(shape=(3), order='C', device='cpu', writable=False)] | None = None) -> None:
    """Writes the derivatives (13,) of `component_derivatives`."""

def actuated_derivatives(state: Annotated[NDArray[numpy.float64], dict(shape=(15), order='C', device='cpu', writable=False)], command: Annotated[NDArray[numpy.float64], dict(shape=(4), order='C', device='cpu', writable=False)], parameters: Annotated[NDArray[numpy.float64], dict(shape=(30), order='C', device='cpu', writable=False)], derivatives: Annotated[NDArray[numpy.float64], dict(shape=(15), order='C', device='cpu')]) -> None:
    """
    Writes the derivatives (15,) of `actuated_derivatives`, without that of the charge, for
    parameters in the order of FLIGHT_PARAMETERS.
    """
