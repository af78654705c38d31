"""Fast rendering of Gaussian scenes that do not change (numpy only, CPU)."""

import os
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from splatpilot import _native
from splatpilot.systems.common.validation import require, require_type
from splatpilot.systems.splats.background import (
    BLACK,
    Background,
    EnvironmentMap,
    RenderedView,
    put_behind,
)
from splatpilot.systems.splats.lens import Distortion, hidden_pixels, native_lens
from splatpilot.systems.splats.scene import GaussianScene, harmonic_degree

if TYPE_CHECKING:
    from pydrake.math import RigidTransform

EPS2D = 0.3  # [px^2] variance by which the pixel blurs every Gaussian, as in gsplat


class PlacedGaussians(NamedTuple):
    """N Gaussians in W, see `GaussianScene`; opacities may be zero."""

    means: NDArray[np.float32]  # (N, 3) [m]
    quats: NDArray[np.float32]  # (N, 4)
    scales: NDArray[np.float32]  # (N, 3) [m]
    opacities: NDArray[np.float32]  # (N,)
    sh: NDArray[np.float32]  # (N, K, 3)


NO_GAUSSIANS = PlacedGaussians(
    *(np.zeros(shape, np.float32) for shape in ((0, 3), (0, 4), (0, 3), (0,), (0, 1, 3)))
)


def placed_together(parts: "Sequence[GaussianScene | PlacedGaussians]") -> PlacedGaussians:
    """Concatenates Gaussians; lower degrees of spherical harmonics are padded with zeros."""
    if not parts:
        return NO_GAUSSIANS
    count = max(part.sh.shape[1] for part in parts)
    means, quats, scales, opacities = (
        np.concatenate([getattr(part, name) for part in parts])
        for name in PlacedGaussians._fields[:-1]
    )
    padded = [np.pad(part.sh, ((0, 0), (0, count - part.sh.shape[1]), (0, 0))) for part in parts]
    return PlacedGaussians(means, quats, scales, opacities, np.concatenate(padded))


class MovingGaussians:
    """M bodies of Gaussians that move without rotating.

    Args:
        bodies: each about its own center.
        centers: from a time [s] to the centers (M, 3) [m]; infinite for an absent body.
    """

    def __init__(
        self, bodies: Sequence[GaussianScene], centers: Callable[[float], NDArray]
    ) -> None:
        self.bodies = list(bodies)
        self._about_centers = placed_together(bodies)
        self._body = np.repeat(np.arange(len(bodies)), [len(body) for body in bodies])
        self._centers = centers

    def at(self, time: float) -> PlacedGaussians:
        """Returns the Gaussians at a time [s]; those of absent bodies have no opacity."""
        centers = self._centers(time)
        present = np.isfinite(centers).all(axis=1)
        own = self._about_centers
        offsets = np.where(present[:, None], centers, 0.0).astype(np.float32)
        placed = own._replace(means=own.means + offsets[self._body])
        if present.all():
            return placed
        return placed._replace(opacities=own.opacities * present[self._body])


def create_renderer(threads: int = 1, simd: str = "") -> _native.Renderer:
    """Creates CPU threads and memory for several images, which do not depend on either.

    Args:
        threads: 1 to 1024; an OSError if the system refuses to start them.
        simd: one of `splatpilot._native.simd_levels()`; by default the environment variable
            SPLATPILOT_SIMD, else the widest of this machine.
    """
    return _native_threads(_native.Renderer, threads, simd)


def _native_threads(make: Any, threads: int, simd: str) -> Any:
    require(1 <= int(threads) <= 1024, "threads", "in [1, 1024]", threads)
    try:
        return make(int(threads), simd or os.environ.get("SPLATPILOT_SIMD", ""))
    except RuntimeError as error:
        raise OSError(f"{error}; request fewer threads") from error


def check_camera(K: ArrayLike, width: int, height: int, near: float, far: float) -> np.ndarray:
    """Checks a pinhole camera and returns `K` as a (3, 3) float64 array."""
    K = np.asarray(K, dtype=np.float64)
    require(K.shape == (3, 3), "K", "of shape (3, 3)", K.shape)
    require(np.isfinite(K).all(), "K", "finite", K.tolist())
    focal = K[0, 0], K[1, 1]
    require(min(focal) > 0, "the focal lengths of K", "> 0 px", "{:g}, {:g}".format(*focal))
    size = 0 < width <= 32768 and 0 < height <= 32768
    require(size, "the image size", "in [1, 32768] px", f"{width} x {height}")
    require(0 < near < far, "the depth range", "0 < near < far", f"{near:g} to {far:g} m")
    return K


def _native_gaussians(gaussians: "GaussianScene | PlacedGaussians") -> _native.Gaussians:
    means, quats, scales, opacities, sh = (
        np.ascontiguousarray(getattr(gaussians, name), dtype=np.float32)
        for name in PlacedGaussians._fields
    )
    return _native.Gaussians(
        means=means,
        quats=quats,
        scales=scales,
        opacities=opacities,
        colors=sh,
        sh_degree=harmonic_degree(sh.shape[1]),
    )


class BakedScene:
    """A Gaussian scene prepared for fast repeated rendering.

    Images agree with `rasterize` up to rounding, except that Gaussians of exactly equal depth blend
    in Morton order. Rendering is deterministic for any number of threads. Several Python threads
    may call `render` at once; they take turns.
    """

    def __init__(self, scene: GaussianScene, threads: int = 1, simd: str = ""):
        """Bakes a scene without keeping a reference to it; see `create_renderer`."""
        self._renderer = create_renderer(threads, simd)
        self._scene = _native.BakedScene(_native_gaussians(scene))
        self._antialiased = getattr(scene, "antialiased", False)

    def recolored(self, sh: np.ndarray) -> "BakedScene":
        """Returns the same Gaussians in other colors, `sh` (N, K, 3), without baking again."""
        sh = np.ascontiguousarray(sh, dtype=np.float32)
        count = self._scene.count
        valid = sh.ndim == 3 and sh.shape[::2] == (count, 3)
        require(valid, "sh", f"of shape ({count}, K, 3)", sh.shape)
        recolored = object.__new__(BakedScene)
        recolored._scene = self._scene.recolored(sh, harmonic_degree(sh.shape[1]))
        recolored._renderer = self._renderer
        recolored._antialiased = self._antialiased
        return recolored

    def render(
        self,
        K: ArrayLike,
        width: int,
        height: int,
        X_WC: "RigidTransform",
        near: float = 0.01,
        far: float = 1e10,
        background: Background = BLACK,
        moving: PlacedGaussians = NO_GAUSSIANS,
        distortion: Distortion | None = None,
        max_depth: float = np.inf,
    ) -> RenderedView:
        """Renders color, median depth and alpha.

        Args:
            K: (3, 3) pinhole intrinsics [px]; skew is ignored. Pixel centers lie at +1/2.
            width, height: of the image [px].
            X_WC: Pose of the camera (x right, y down, z forward) in the world.
            near, far: Gaussians with a center outside these depths are left out [m].
            background: color or environment behind everything.
            moving: Gaussians added to those of the scene for this image; not checked.
            distortion: Lens; a pinhole if None. Pixels without a ray are black, with alpha and
                depth 0.
            max_depth: Gaussians beyond this depth [m] are left out of the depth image.
        """
        environment = background if isinstance(background, EnvironmentMap) else None
        color = np.array(BLACK if environment else background, dtype=np.float32)
        valid = color.shape == (3,) and np.isfinite(color).all()
        require(valid, "background", "3 finite numbers", color.tolist())
        options = {"moving": moving, "distortion": distortion, "max_depth": max_depth}
        depth, seen, alpha = self._render(K, width, height, X_WC, near, far, color, **options)
        view = RenderedView(seen, depth[..., 0], alpha[..., 0])
        if environment is None:
            return view
        return put_behind(view, environment, np.asarray(K), X_WC, distortion)

    def render_depth(self, *camera: Any, **options: Any) -> NDArray[np.float32]:
        """Renders the median depth (H, W) [m], bitwise identical to that of `render` but faster.

        The arguments are those of `render` but `background`; all beyond `far` by name.
        """
        return self._render(*camera, **options)[0][..., 0]

    def _render(
        self,
        K: ArrayLike,
        width: int,
        height: int,
        X_WC: "RigidTransform",
        near: float = 0.01,
        far: float = 1e10,
        background: NDArray[np.float32] | None = None,
        moving: PlacedGaussians = NO_GAUSSIANS,
        distortion: Distortion | None = None,
        max_depth: float = np.inf,
    ) -> list[NDArray[np.float32]]:
        """Returns depth (H, W, 1) and, with a background, color (H, W, 3) and alpha (H, W, 1)."""
        camera = _checked_camera(K, width, height, near, far, max_depth, distortion)
        depth, color, alpha = (np.empty((height, width, n), np.float32) for n in (1, 3, 1))
        whole = background is not None
        _native.render_baked(
            self._scene,
            self._renderer,
            _native_gaussians(moving),
            camera(self._antialiased, X_WC),
            background=background if whole else np.zeros(3, np.float32),
            color=color if whole else None,
            depth=depth,
            alpha=alpha if whole else None,
        )
        images = [depth, color, alpha] if whole else [depth]
        _hide_pixels(images, distortion, K)
        return images


class BatchRenderer:
    """Renders views of baked scenes, several at once, each on one thread.

    Images are bitwise those of `BakedScene`. The N cameras differ in scene and pose alone. See
    `create_renderer` for the arguments.
    """

    def __init__(self, threads: int = 1, simd: str = ""):
        self._renderer = _native_threads(_native.BatchRenderer, threads, simd)

    def render(
        self,
        scenes: Sequence[BakedScene],
        K: ArrayLike,
        width: int,
        height: int,
        X_WCs: "Sequence[RigidTransform]",
        near: float = 0.01,
        far: float = 1e10,
        backgrounds: Sequence[Background] | None = None,
        distortion: Distortion | None = None,
        max_depth: float = np.inf,
    ) -> RenderedView:
        """Renders color (N, H, W, 3), median depth and alpha (N, H, W); see `BakedScene.render`.

        Args:
            scenes: of the N views.
            X_WCs: poses of the N cameras.
            backgrounds: of the N views; black if None.
        """
        backgrounds = [BLACK] * len(scenes) if backgrounds is None else backgrounds
        maps = {i: b for i, b in enumerate(backgrounds) if isinstance(b, EnvironmentMap)}
        colors = np.array([BLACK if i in maps else b for i, b in enumerate(backgrounds)], "f4")
        shape = len(scenes), 3
        valid = colors.reshape(-1, 3).shape == shape and np.isfinite(colors).all()
        require(valid, "backgrounds", f"{shape} finite numbers", colors.tolist())
        options = {"backgrounds": colors, "distortion": distortion, "max_depth": max_depth}
        depth, color, alpha = self._render(scenes, K, width, height, X_WCs, near, far, **options)
        for i, environment in maps.items():
            view = RenderedView(color[i], depth[i, ..., 0], alpha[i, ..., 0])
            color[i] = put_behind(view, environment, np.asarray(K), X_WCs[i], distortion).color
        return RenderedView(color, depth[..., 0], alpha[..., 0])

    def render_depth(
        self, scenes: Sequence[BakedScene], *cameras: Any, **options: Any
    ) -> NDArray[np.float32]:
        """Renders the median depth (N, H, W) [m] alone, which is faster.

        The arguments are those of `render` but `backgrounds`; all beyond `far` by name.
        """
        return self._render(scenes, *cameras, **options)[0][..., 0]

    def _render(
        self,
        scenes: Sequence[BakedScene],
        K: ArrayLike,
        width: int,
        height: int,
        X_WCs: "Sequence[RigidTransform]",
        near: float = 0.01,
        far: float = 1e10,
        backgrounds: NDArray[np.float32] | None = None,
        distortion: Distortion | None = None,
        max_depth: float = np.inf,
    ) -> list[NDArray[np.float32]]:
        """Returns depth and, with backgrounds, color and alpha, each (N, H, W, channels)."""
        count = len(scenes)
        require(len(X_WCs) == count, "the number of poses", f"that of scenes, {count}", len(X_WCs))
        camera = _checked_camera(K, width, height, near, far, max_depth, distortion)
        cameras = [
            camera(scene._antialiased, X_WC) for scene, X_WC in zip(scenes, X_WCs, strict=True)
        ]
        depth, color, alpha = (np.empty((count, height, width, n), np.float32) for n in (1, 3, 1))
        whole = backgrounds is not None
        _native.render_views(
            self._renderer,
            [scene._scene for scene in scenes],
            cameras,
            backgrounds=backgrounds if whole else np.zeros((count, 3), np.float32),
            color=color if whole else None,
            depth=depth,
            alpha=alpha if whole else None,
        )
        images = [depth, color, alpha] if whole else [depth]
        _hide_pixels(images, distortion, K)
        return images


def _checked_camera(
    K: ArrayLike,
    width: int,
    height: int,
    near: float,
    far: float,
    max_depth: float,
    distortion: Distortion | None,
) -> "Callable[[bool, RigidTransform], _native.Camera]":
    """Checks a camera; returns the function from antialiasing and the pose to the native one."""
    K = check_camera(K, width, height, near, far)
    require(max_depth > 0, "max_depth", "> 0 m", max_depth)
    lens = {} if distortion is None else native_lens(distortion, K, width, height)._asdict()
    options = {"near_plane": near, "far_plane": far, "eps2d": EPS2D, "max_depth": max_depth, **lens}

    def make(antialiased: bool, X_WC: "RigidTransform") -> _native.Camera:
        X_CW = np.ascontiguousarray(X_WC.inverse().GetAsMatrix4())
        size = {"width": width, "height": height, "antialiased": antialiased}
        return _native.Camera(K=K, X_CW=X_CW, **size, **options)

    return make


def _hide_pixels(
    images: list[NDArray[np.float32]], distortion: Distortion | None, K: ArrayLike
) -> None:
    """Sets pixels without a ray to zero, in images (..., H, W, channels)."""
    if distortion is None:
        return
    for image in images:
        height, width, channels = image.shape[-3:]
        hidden = hidden_pixels(distortion, np.asarray(K, float), width, height)
        image.reshape(-1, height * width, channels)[:, hidden] = 0.0


def bake(scene: BakedScene | GaussianScene) -> BakedScene:
    """Bakes a scene unless it is baked."""
    scene = BakedScene(scene) if isinstance(scene, GaussianScene) else scene
    require_type(scene, BakedScene, "scene", "pass `baked` or `gaussians` of a world")
    return scene
