"""Worlds from meshes, drawn by Drake's render engine."""

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from splatpilot.diagrams.worlds.feasibility import SHORTEST, choose_ends
from splatpilot.diagrams.worlds.mesh import check_mesh, mesh_distance, sample_colors
from splatpilot.diagrams.worlds.mesh_renderer import MeshRenderer, shade
from splatpilot.diagrams.worlds.solids.surfaces import (
    COVERAGE,
    Surfels,
    perpendicular,
    to_gaussians,
)
from splatpilot.diagrams.worlds.world import World
from splatpilot.systems.common.files import find_data
from splatpilot.systems.common.validation import Config, bounded, require, require_field
from splatpilot.systems.splats.background import BLACK, Background, RenderedView
from splatpilot.systems.splats.baked_scene import NO_GAUSSIANS, BakedScene, PlacedGaussians
from splatpilot.systems.splats.lens import Distortion, pixel_slopes
from splatpilot.systems.splats.splat_camera import empty_scene

if TYPE_CHECKING:
    from pydrake.math import RigidTransform

_NEAR, _FAR = 0.02, 500.0  # [m], range of depth in which the mesh is drawn
_MAX_SLOPE = 4.0  # of rays of a lens, 76 degrees from the axis
_PREVIEW = 120_000  # number of Gaussians that show the mesh on pages
_GAP = 1.5  # times the spacing of an even grid, between points drawn at random


@dataclass
class MeshWorld(Config):
    """An environment as a mesh (.glb, .gltf or .obj) on disk; cameras show the mesh itself."""

    path: str = ""  # here, or in the folder of data (SPLATPILOT_DATA)
    up: str = bounded("y", "{y, z}")  # axis of the file that points up: y, as glTF says, or z
    scale: float = bounded(1.0, "(0, inf) m")  # unit of the file
    # [m] Of the distance field; 0: 0.1 m, or more for 20 million voxels.
    voxel_size: float = bounded(0.0, "[0, inf) m")
    # Color of the sky; red, green, blue in 0 to 1.
    background: list[float] = bounded(lambda: [0.6, 0.75, 0.9], "[0, 1]")
    # If true, start and goal are drawn from the seed; otherwise a long route decides.
    draw_ends: bool = False
    # [m] Minimum length of the shortest route between ends that are drawn.
    min_path: float = bounded(SHORTEST, "[0, inf) m")

    def check(self) -> None:
        require_field(self, "path", self.path, "a mesh")
        require_field(self, "background", len(self.background) == 3, "red, green and blue")


def mesh_world(config: MeshWorld, seed: int) -> World:
    """Reads the mesh of `config`."""
    config.validate()
    path = find_data(Path(config.path), "a mesh")
    check_mesh(path, config.up)
    esdf = mesh_distance(path, config.up, config.voxel_size, config.scale)
    drawn = {"min_length": config.min_path, "seed": seed} if config.draw_ends else {}
    ends = choose_ends(esdf, config.path, **drawn)
    points, normals, colors, area = sample_colors(path, config.up, config.scale, _PREVIEW)
    extent = np.full((len(points), 2), _GAP * COVERAGE * np.sqrt(area / len(points)))
    surfels = Surfels(points, normals, perpendicular(normals), extent)
    gaussians = to_gaussians(surfels, shade(colors, normals), 0.99)
    sky = tuple(config.background)
    scene = MeshScene(path, config.up, sky, config.scale)
    return World(path.stem, gaussians, esdf, esdf, sky, *ends, rendered=scene)


class MeshScene(BakedScene):
    """A mesh that cameras render as a `BakedScene`."""

    def __init__(self, path: Path, up: str, background: Any, scale: float) -> None:
        self._mesh = path, up, background, scale

    @cached_property
    def _renderer(self) -> MeshRenderer:
        return MeshRenderer(*self._mesh)

    def recolored(self, sh: np.ndarray) -> BakedScene:
        raise ValueError("appearance must be 0 in a mesh, whose textures are not randomized")

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
        with_color: bool = True,
    ) -> RenderedView:
        """Renders color and depth; see `BakedScene.render`. The background is that of the mesh, and
        `merged_spread` has no effect."""
        span = max(near, _NEAR), min(far, _FAR)
        color, depth = self._images(K, (width, height), X_WC, span, distortion, with_color)
        view = RenderedView((color / 255).astype(np.float32), depth, (depth > 0).astype(np.float32))
        if len(moving.means):
            camera = np.asarray(K, float), width, height, X_WC, near, far
            bodies = empty_scene().render(*camera, moving=moving, distortion=distortion)
            view = _in_front(view, bodies)
        depth = np.where(view.depth <= max_depth, view.depth, np.float32(0))
        return view._replace(depth=depth)

    def render_color(self, *camera: Any, **options: Any) -> NDArray[np.float32]:
        """Renders color (H, W, 3); see `BakedScene.render_color`."""
        return self.render(*camera, **options).color

    def render_depth(self, *camera: Any, **options: Any) -> NDArray[np.float32]:
        """Renders depth (H, W) [m]; see `BakedScene.render_depth`."""
        return self.render(*camera, **options, with_color=False).depth

    def _images(
        self,
        K: ArrayLike,
        size: tuple[int, int],
        X_WC: "RigidTransform",
        span: tuple[float, float],
        distortion: Distortion | None,
        with_color: bool,
    ) -> tuple[NDArray[Any], NDArray[Any]]:
        """Returns color (H, W, 3), black if not asked, and depth (H, W) [m], 0 without a surface.

        Args:
            size: width and height [px].
            span: smallest and largest depth [m].
        """
        K, slopes = np.array(K, dtype=np.float64), None
        if distortion is not None:
            # A pinhole camera around all rays of the lens, from which the image is resampled.
            slopes = pixel_slopes(distortion, K, *size)
            lower, upper = np.nanmin(slopes, axis=(0, 1)), np.nanmax(slopes, axis=(0, 1))
            widest = max(-lower.min(), upper.max())
            require(widest < _MAX_SLOPE, "slopes of rays in a mesh", f"< {_MAX_SLOPE}", widest)
            focal = K[[0, 1], [0, 1]]
            K[:2, 2] = 1 - focal * lower
            size = tuple(np.ceil(focal * (upper - lower) + 2).astype(int).tolist())
        images = self._renderer.render(X_WC, K, *size, depth_range=span, with_color=with_color)
        seen = np.where(np.isfinite(images.depth), images.depth, np.float32(0))
        if slopes is None:
            return images.color, seen
        points = (slopes * K[[0, 1], [0, 1]] + K[:2, 2] - 0.5).astype(np.float32)
        hidden = np.isnan(points[..., 0])
        points[hidden] = -1e6  # outside, where remap fills with 0
        u, v = np.ascontiguousarray(points[..., 0]), np.ascontiguousarray(points[..., 1])
        color = cv2.remap(images.color, u, v, cv2.INTER_LINEAR)
        return np.asarray(color), np.asarray(cv2.remap(seen, u, v, cv2.INTER_NEAREST))


def _in_front(view: RenderedView, bodies: RenderedView) -> RenderedView:
    """Returns the view with bodies drawn where they are nearer; both on their own backgrounds."""
    nearer = (bodies.depth > 0) & ((view.depth == 0) | (bodies.depth < view.depth))
    over = bodies.color + (1 - bodies.alpha[..., None]) * view.color
    return RenderedView(
        np.where(nearer[..., None], over, view.color).astype(np.float32),
        np.where(nearer, bodies.depth, view.depth),
        np.where(nearer, np.maximum(bodies.alpha, view.alpha), view.alpha),
    )
