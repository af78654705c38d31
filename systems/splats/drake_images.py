"""Views of Gaussians as Drake's images: its cameras, depth ranges and labels."""

import numpy as np
from numpy.typing import NDArray
from pydrake.geometry import RenderLabel
from pydrake.math import RigidTransform

from splatpilot.systems.splats.background import (
    BLACK,
    Background,
    EnvironmentMap,
    put_behind,
)
from splatpilot.systems.splats.baked_scene import BakedScene, RenderedView
from splatpilot.systems.splats.distortion import Distortion
from splatpilot.systems.splats.moving_gaussians import NO_GAUSSIANS, PlacedGaussians


def render_view(
    scene: BakedScene,
    K: NDArray[np.float64],
    width: int,
    height: int,
    X_WC: RigidTransform,
    near: float,
    far: float,
    background: Background = BLACK,
    moving: PlacedGaussians = NO_GAUSSIANS,
    distortion: Distortion | None = None,
    max_depth: float = np.inf,
) -> RenderedView:
    """What a camera of intrinsics K [px] at X_WC sees, through a lens; see `BakedScene.render`.

    Drake's renderers and ours both have the centre of pixel (i, j) at (i + 1/2, j + 1/2), so its
    intrinsics are taken as they are.
    """
    camera = (K, width, height, X_WC, near, far)
    if not isinstance(background, EnvironmentMap):
        return scene.render(*camera, background, moving, distortion, max_depth)
    view = scene.render(*camera, BLACK, moving, distortion, max_depth)
    return put_behind(view, background, K, X_WC, distortion)


def color_pixels(color: NDArray) -> NDArray[np.uint8]:
    """Colours in [0, 1], clipped, as the nearest of 0 to 255."""
    return np.clip(color * 255.0 + 0.5, 0.0, 255.0).astype(np.uint8)


def ranged_depth(
    depth: NDArray[np.float32], min_depth: float, max_depth: float
) -> NDArray[np.float32]:
    """Planar depth (H, W) [m], 0 where there is no surface, as Drake's cameras show it.

    Nearer than `min_depth` reads 0 and farther than `max_depth` reads infinity; so does a pixel
    without a surface.
    """
    seen = (depth > 0) & (depth <= max_depth)
    return np.where(seen, np.where(depth < min_depth, np.float32(0), depth), np.inf)


def surface_labels(view: RenderedView) -> NDArray[np.int16]:
    """`RenderLabel.kUnspecified` where there is a surface and `RenderLabel.kEmpty` elsewhere:
    Gaussians carry no semantics  # (H, W).
    """
    unspecified, empty = int(RenderLabel.kUnspecified), int(RenderLabel.kEmpty)
    return np.where(view.depth > 0, unspecified, empty).astype(np.int16)
