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
from splatpilot.systems.splats.lens import NUM_RADIAL, Distortion, native_lens, pixel_slopes
from splatpilot.systems.splats.scene import ARRAYS, GaussianScene, concatenated, harmonic_degree

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
    return PlacedGaussians(**concatenated(parts)) if parts else NO_GAUSSIANS


def create_renderer(threads: int = 1, simd: str = "") -> _native.Renderer:
    """Creates CPU threads and memory for several images, which do not depend on either.

    Args:
        threads: 1 to 1024.
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
    *shapes, sh = (
        np.ascontiguousarray(getattr(gaussians, name), dtype=np.float32) for name in ARRAYS
    )
    arrays = dict(zip(ARRAYS[:-1], shapes, strict=True))
    return _native.Gaussians(**arrays, colors=sh, sh_degree=harmonic_degree(sh.shape[1]))


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
        vars(recolored).update(vars(self))
        recolored._scene = self._scene.recolored(sh, harmonic_degree(sh.shape[1]))
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
        merged_spread: float = 0.0,
        rows: tuple[int, int] | None = None,
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
            merged_spread: Neighbors that spread by less on the image [px] are drawn as one in
                color and alpha, which is faster where Gaussians are smaller than pixels; 0 merges
                none. The first such image prepares the scene.
            rows: The first row to render, and the one after the last; by default all.
        """
        options = {"moving": moving, "distortion": distortion, "max_depth": max_depth}
        options |= {"background": background, "merged_spread": merged_spread, "rows": rows}
        camera = K, width, height, X_WC, near, far
        return _render_all(self._render, [self], *camera, **options)

    def render_color(self, *camera: Any, **options: Any) -> NDArray[np.float32]:
        """Renders the color (H, W, 3), bitwise identical to that of `render` but faster.

        The arguments are those of `render`; all beyond `far` by name.
        """
        return self._render(("color", "alpha"), *camera, **options).color

    def render_depth(self, *camera: Any, **options: Any) -> NDArray[np.float32]:
        """Renders the median depth (H, W) [m] alone, see `render_color`."""
        return self._render(("depth",), *camera, **options).depth

    def _render(
        self,
        names: tuple[str, ...],
        K: ArrayLike,
        width: int,
        height: int,
        X_WC: "RigidTransform",
        *clip: float,
        background: Background = BLACK,
        moving: PlacedGaussians = NO_GAUSSIANS,
        **options: Any,
    ) -> RenderedView:
        def draw(cameras: list[_native.Camera], colors: NDArray, images: dict[str, Any]) -> None:
            scene = self._scene, self._renderer, _native_gaussians(moving)
            _native.render_baked(*scene, cameras[0], background=colors[0], **images)

        views = [self], [X_WC], [background]
        return _render_views(draw, names, (), views, K, width, height, *clip, **options)


class BatchRenderer:
    """Renders views of baked scenes, several at once, each on one thread.

    Images are bitwise those of `BakedScene`. The N cameras differ in scene and pose alone. See
    `create_renderer` for the arguments.
    """

    def __init__(self, threads: int = 1, simd: str = ""):
        self._renderer = _native_threads(_native.BatchRenderer, threads, simd)

    def render(self, *cameras: Any, **options: Any) -> RenderedView:
        """Renders color (N, H, W, 3), median depth and alpha (N, H, W).

        Args:
            cameras: the scenes of the N views, and the arguments of `BakedScene.render` but
                `moving`, with the N poses X_WC; all beyond `far` by name.
            options: the same; `backgrounds` are those of the N views, black by default.
        """
        return _render_all(self._render, cameras[0], *cameras, **options)

    def render_color(self, *cameras: Any, **options: Any) -> NDArray[np.float32]:
        """Renders the colors (N, H, W, 3) alone, which is faster; see `render`."""
        return self._render(("color", "alpha"), *cameras, **options).color

    def render_depth(self, *cameras: Any, **options: Any) -> NDArray[np.float32]:
        """Renders the median depth (N, H, W) [m] alone, which is faster; see `render`."""
        return self._render(("depth",), *cameras, **options).depth

    def _render(
        self,
        names: tuple[str, ...],
        scenes: Sequence[BakedScene],
        K: ArrayLike,
        width: int,
        height: int,
        X_WCs: "Sequence[RigidTransform]",
        *clip: float,
        backgrounds: Sequence[Background] | None = None,
        **options: Any,
    ) -> RenderedView:
        count = len(scenes)
        backgrounds = [BLACK] * count if backgrounds is None else backgrounds
        for name, rows in (("poses", X_WCs), ("backgrounds", backgrounds)):
            condition = f"that of scenes, {count}"
            require(len(rows) == count, f"the number of {name}", condition, len(rows))

        def draw(cameras: list[_native.Camera], colors: NDArray, images: dict[str, Any]) -> None:
            baked = [scene._scene for scene in scenes]
            _native.render_views(self._renderer, baked, cameras, backgrounds=colors, **images)

        views = scenes, X_WCs, backgrounds
        return _render_views(draw, names, (count,), views, K, width, height, *clip, **options)


def _render_all(
    render: Callable[..., RenderedView], scenes: Sequence[BakedScene], *cameras: Any, **options: Any
) -> RenderedView:
    """Renders all images, color and depth apart if their Gaussians differ: where neighbors merge,
    and in scenes that were trained antialiased, whose opacities blur makes lower for color."""
    merges = options.get("merged_spread", 0.0) > 0
    if not merges and not any(scene._antialiased for scene in scenes):
        return render(tuple(_CHANNELS), *cameras, **options)
    depth = render(("depth",), *cameras, **options).depth
    return render(("color", "alpha"), *cameras, **options)._replace(depth=depth)


_CHANNELS = {"color": 3, "depth": 1, "alpha": 1}


def _render_views(
    draw: Callable[..., None],
    names: tuple[str, ...],
    shape: tuple[int, ...],
    views: "tuple[Sequence[BakedScene], Sequence[RigidTransform], Sequence[Background]]",
    K: ArrayLike,
    width: int,
    height: int,
    near: float = 0.01,
    far: float = 1e10,
    *,
    distortion: Distortion | None = None,
    max_depth: float = np.inf,
    merged_spread: float = 0.0,
    rows: tuple[int, int] | None = None,
) -> RenderedView:
    """Renders images (*shape, H, W, channels) of these names; the others are empty.

    Args:
        draw: takes native cameras, colors (N, 3) behind them, and images.
        shape: () for one view, else (N,).
        views: scenes, poses X_WC and backgrounds.
    """
    K = check_camera(K, width, height, near, far)
    require(max_depth > 0, "max_depth", "> 0 m", max_depth)
    require(0 <= merged_spread < np.inf, "merged_spread", "finite and >= 0 px", merged_spread)
    merged_spread = merged_spread if "color" in names else 0.0
    first, last = rows or (0, height)
    require(0 <= first < last <= height, "rows", f"in [0, {height}], ascending", rows)
    K_rows, num_rows = K.copy(), last - first
    K_rows[1, 2] -= first
    lens = {}
    if distortion is not None:
        whole = native_lens(distortion, K, width, height)
        part = native_lens(distortion, K_rows, width, num_rows)
        model = 1 + list(NUM_RADIAL).index(distortion.model)
        lens = {"distortion": model, "lens": np.append(whole[:13], part[13:])}
    scenes, X_WCs, backgrounds = views
    cameras = []
    for scene, X_WC in zip(scenes, X_WCs, strict=True):
        if merged_spread:
            scene._scene.merge_neighbors()
        camera = _native.Camera(
            K=K_rows,
            X_CW=np.ascontiguousarray(X_WC.inverse().GetAsMatrix4()),
            width=width,
            height=num_rows,
            rows_above=first,
            rows_below=height - last,
            near_plane=near,
            far_plane=far,
            eps2d=EPS2D,
            max_depth=max_depth,
            merged_spread=merged_spread,
            antialiased=scene._antialiased,
            **lens,
        )
        cameras.append(camera)
    # Environments follow.
    colors = [BLACK if isinstance(each, EnvironmentMap) else each for each in backgrounds]
    for color in colors:
        valid = len(color) == 3 and np.isfinite(color).all()
        require(valid, "background", "3 finite numbers", list(color))
    images = {
        name: np.empty((*shape, *((num_rows, width) if name in names else (0, 0)), n), np.float32)
        for name, n in _CHANNELS.items()
    }
    drawn = {name: image if name in names else None for name, image in images.items()}
    draw(cameras, np.array(colors, np.float32).reshape(-1, 3), drawn)
    view = RenderedView(images["color"], images["depth"][..., 0], images["alpha"][..., 0])
    has_sky = any(isinstance(each, EnvironmentMap) for each in backgrounds)
    if distortion is None and not has_sky:
        return view
    slopes = pixel_slopes(distortion, K, width, height)[first:last]
    hidden = np.isnan(slopes[..., 0])
    for name in names:
        images[name][..., hidden, :] = 0.0
    for i, background in enumerate(backgrounds):
        if isinstance(background, EnvironmentMap) and view.color.size:
            part = RenderedView(*(image[i] for image in view)) if shape else view
            part.color[:] = put_behind(part, background, slopes, X_WCs[i]).color
    return view


def bake(scene: BakedScene | GaussianScene) -> BakedScene:
    """Bakes a scene unless it is baked."""
    scene = BakedScene(scene) if isinstance(scene, GaussianScene) else scene
    require_type(scene, BakedScene, "scene", "pass `baked` or `gaussians` of a world")
    return scene
