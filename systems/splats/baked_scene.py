"""Rendering of scenes that do not change: the renderer of the flight path (numpy only, CPU)."""

import os
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from splatpilot import _native
from splatpilot.systems.splats.lens import Distortion, hidden_pixels, native_lens
from splatpilot.systems.splats.scene import GaussianScene, degree_of


class PlacedGaussians(NamedTuple):
    """N Gaussians in W; float32, see `GaussianScene`. An opacity may be zero."""

    means: NDArray[np.float32]  # (N, 3) [m]
    quats: NDArray[np.float32]  # (N, 4)
    scales: NDArray[np.float32]  # (N, 3) [m]
    opacities: NDArray[np.float32]  # (N,)
    sh: NDArray[np.float32]  # (N, K, 3)


NO_GAUSSIANS = PlacedGaussians(
    *(np.zeros(shape, np.float32) for shape in ((0, 3), (0, 4), (0, 3), (0,), (0, 1, 3)))
)


class MovingGaussians:
    """M bodies of Gaussians that move without turning.

    Args:
        bodies: each about its own centre; all of one degree of spherical harmonics.
        centers: from a time [s] to where the centres are, (M, 3) [m]; infinite for a body that is
            nowhere.
    """

    def __init__(
        self, bodies: Sequence[GaussianScene], centers: Callable[[float], NDArray]
    ) -> None:
        self._about_centers = PlacedGaussians(
            *(
                np.concatenate([getattr(body, name) for body in bodies] or [none])
                for name, none in NO_GAUSSIANS._asdict().items()
            )
        )
        self._body = np.repeat(np.arange(len(bodies)), [len(body) for body in bodies])
        self._centers = centers

    def at(self, time: float) -> PlacedGaussians:
        """The Gaussians at a time [s]; those of bodies that are nowhere have no opacity."""
        centers = self._centers(time)
        present = np.isfinite(centers).all(axis=1)
        own = self._about_centers
        offsets = np.where(present[:, None], centers, 0.0).astype(np.float32)
        placed = own._replace(means=own.means + offsets[self._body])
        if present.all():
            return placed
        return placed._replace(opacities=own.opacities * present[self._body])


if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray
    from pydrake.math import RigidTransform

    from splatpilot.systems.splats.scene import GaussianScene

EPS2D = 0.3  # [px^2] variance by which the pixel blurs every Gaussian, as in gsplat


class RenderedView(NamedTuple):
    """What a camera sees of a scene, float32."""

    color: "NDArray[np.float32]"  # (H, W, 3), over the background
    depth: "NDArray[np.float32]"  # (H, W) [m] median z, see `rasterize`; 0: no surface
    alpha: "NDArray[np.float32]"  # (H, W) in [0, 1]


def create_renderer(threads: int = 1, simd: str = "") -> _native.Renderer:
    """CPU threads, and memory that one image after another is rendered in.

    Whatever renders several images should do so with one renderer: the first image asks the system
    for memory, and later ones use it again. Python threads that share one take turns. What is
    rendered depends neither on the threads nor on earlier images.

    `simd` (default: the environment variable SPLATPILOT_SIMD, else the widest that the machine has)
    is one of `splatpilot._native.simd_levels()`.

    Raises:
        ValueError: `threads` is not a positive integer, or this machine lacks the SIMD level.
        OSError: the system does not let this process start so many threads.
    """
    if not 1 <= int(threads) <= 1024:
        raise ValueError(f"threads is {threads}; it must lie between 1 and 1024")
    try:
        return _native.Renderer(int(threads), simd or os.environ.get("SPLATPILOT_SIMD", ""))
    except RuntimeError as error:
        raise OSError(f"{error}; ask for fewer threads") from error


def check_camera(K: "ArrayLike", width: int, height: int, near: float, far: float) -> np.ndarray:
    """Returns `K` as a (3, 3) float64 array, or raises ValueError naming what is wrong."""
    K = np.asarray(K, dtype=np.float64)
    if K.shape != (3, 3):
        raise ValueError(f"K has shape {K.shape}; it must be the 3x3 matrix of intrinsics [px]")
    if not np.all(np.isfinite(K)):
        raise ValueError(f"K has a NaN or infinite entry: {K.tolist()}")
    if K[0, 0] <= 0 or K[1, 1] <= 0:
        raise ValueError(
            f"focal lengths K[0, 0] = {K[0, 0]:g}, K[1, 1] = {K[1, 1]:g} must be positive [px]"
        )
    if not (0 < width <= 32768 and 0 < height <= 32768):
        raise ValueError(f"image size is {width} x {height}; both must lie between 1 and 32768")
    if not 0 < near < far:
        raise ValueError(f"depth range is {near:g} to {far:g} m; it must satisfy 0 < near < far")
    return K


class BakedScene:
    """A Gaussian scene prepared for fast repeated rendering.

    Baking reorders the Gaussians so that neighbours in space are neighbours in memory (Morton
    order), factors their covariances and bounds groups of them with boxes; each frame then skips
    whole groups and starts from what is precomputed. Images agree with `rasterize` up to rounding,
    except that Gaussians of exactly equal depth blend in Morton order.

    The same scene, camera and size give the same bits, for any number of threads. Several Python
    threads may call `render` at once; they take turns.
    """

    def __init__(self, scene: "GaussianScene", threads: int = 1, simd: str = ""):
        """Bakes `scene`, of which no reference is kept.

        Raises:
            ValueError: see `create_renderer`.
        """
        self._renderer = create_renderer(threads, simd)
        names = ("means", "quats", "scales", "opacities", "sh")
        arrays = {n: np.ascontiguousarray(getattr(scene, n), dtype=np.float32) for n in names}
        self._scene = _native.BakedScene(**arrays, sh_degree=degree_of(scene.sh.shape[1]))

    def recolored(self, sh: np.ndarray) -> "BakedScene":
        """The same Gaussians in other colours, by the same renderer, without baking anew: what does
        not depend on colours is shared.

        Args:
            sh: (N, K, 3), see `GaussianScene`, in the order of the scene that was baked.

        Raises:
            ValueError: on another shape, or another number of Gaussians.
        """
        sh = np.ascontiguousarray(sh, dtype=np.float32)
        if sh.ndim != 3 or len(sh) != self._scene.count or sh.shape[2] != 3:
            raise ValueError(
                f"sh has shape {sh.shape}; it must be ({self._scene.count}, K, 3), a row for each "
                "Gaussian that was baked"
            )
        seen = object.__new__(BakedScene)
        seen._scene = self._scene.recolored(sh, degree_of(sh.shape[1]))
        seen._renderer = self._renderer
        return seen

    def render(
        self,
        K: "ArrayLike",
        width: int,
        height: int,
        X_WC: "RigidTransform",
        near: float = 0.01,
        far: float = 1e10,
        background: "ArrayLike" = (0.0, 0.0, 0.0),
        moving: PlacedGaussians = NO_GAUSSIANS,
        distortion: Distortion | None = None,
        max_depth: float = np.inf,
    ) -> RenderedView:
        """Renders colour, median depth and alpha.

        Args:
            K: (3, 3) pinhole intrinsics [px]; skew is ignored. Pixel (i, j) has its centre at
                (i + 1/2, j + 1/2).
            width: Image width [px].
            height: Image height [px].
            X_WC: Pose of the camera (x right, y down, z forward) in the world.
            near: Gaussians whose centre is nearer than this along z are left out [m].
            far: The same for those farther away [m].
            background: (3,) colour behind everything.
            moving: Gaussians among those of the scene, in this image alone; trusted to be valid.
            distortion: of the lens; None for a pinhole. What it does not show is black,
                of alpha and depth 0.
            max_depth: Gaussians of which no surface may lie so near [m] have no part in the depth:
                what an image of depth does not show hides nothing that it shows.

        Raises:
            ValueError: intrinsics, image size, depth range or background make no sense.
        """
        background = np.ascontiguousarray(background, dtype=np.float32)
        if background.shape != (3,) or not np.all(np.isfinite(background)):
            raise ValueError(f"background is {background.tolist()}; it must be 3 finite numbers")
        camera = _camera(K, width, height, X_WC, near, far, distortion)
        color = np.empty((height, width, 3), dtype=np.float32)
        depth = np.empty((height, width, 1), dtype=np.float32)
        alpha = np.empty((height, width, 1), dtype=np.float32)
        _native.render_baked(
            self._scene,
            self._renderer,
            **_among(moving),
            **camera,
            eps2d=EPS2D,
            background=background,
            color=color,
            depth=depth,
            alpha=alpha,
            max_depth=_positive(max_depth),
        )
        _hide((color, depth, alpha), distortion, camera)
        return RenderedView(color, depth[..., 0], alpha[..., 0])

    def render_depth(
        self,
        K: "ArrayLike",
        width: int,
        height: int,
        X_WC: "RigidTransform",
        near: float = 0.01,
        far: float = 1e10,
        max_depth: float = np.inf,
        moving: PlacedGaussians = NO_GAUSSIANS,
        distortion: Distortion | None = None,
    ) -> "NDArray[np.float32]":
        """Renders the median depth of `render` alone, (H, W) [m], in a fraction of its time.

        The arguments are those of `render`, and so are the bits.

        Raises:
            ValueError: intrinsics, image size or depth range make no sense.
        """
        camera = _camera(K, width, height, X_WC, near, far, distortion)
        depth = np.empty((height, width, 1), dtype=np.float32)
        _native.render_baked_depth(
            self._scene,
            self._renderer,
            **_among(moving),
            **camera,
            max_depth=_positive(max_depth),
            depth=depth,
        )
        _hide((depth,), distortion, camera)
        return depth[..., 0]


def _camera(
    K: "ArrayLike",
    width: int,
    height: int,
    X_WC: "RigidTransform",
    near: float,
    far: float,
    distortion: Distortion | None,
) -> dict[str, Any]:
    """The camera as `_native` takes it."""
    K = check_camera(K, width, height, near, far)
    return {
        "K": K,
        "X_CW": np.ascontiguousarray(X_WC.inverse().GetAsMatrix4()),
        "width": width,
        "height": height,
        "near_plane": near,
        "far_plane": far,
        **native_lens(distortion, K, width, height)._asdict(),
    }


def _positive(max_depth: float) -> float:
    if not max_depth > 0:
        raise ValueError(f"max_depth is {max_depth:g} m; it must be positive")
    return max_depth


def _among(moving: PlacedGaussians) -> dict[str, Any]:
    """The Gaussians among those of a scene as `_native` takes them."""
    return {**moving._asdict(), "sh_degree": degree_of(moving.sh.shape[1])}


def _hide(
    images: tuple["NDArray[np.float32]", ...], distortion: Distortion | None, camera: dict[str, Any]
) -> None:
    """Sets what a lens does not show to 0."""
    if distortion is None:
        return
    hidden = hidden_pixels(distortion, camera["K"], camera["width"], camera["height"])
    for image in images if len(hidden) else ():
        image.reshape(-1, image.shape[2])[hidden] = 0.0
