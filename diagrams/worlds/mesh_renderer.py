"""Images of meshes, drawn by Drake's RenderEngineVtk with holes in textures among them."""

from collections.abc import Sequence
from functools import cached_property
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import cv2
import numpy as np
import trimesh
from numpy.typing import ArrayLike, NDArray
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

from splatpilot.diagrams.worlds.mesh import GAMMA, CutOuts, check_mesh, split
from splatpilot.systems.common.extras import require_opengl
from splatpilot.systems.common.readers import readable
from splatpilot.systems.common.validation import require
from splatpilot.systems.splats.background import BLACK, Background, RenderedView
from splatpilot.systems.splats.baked_scene import NO_GAUSSIANS, BakedScene, PlacedGaussians
from splatpilot.systems.splats.lens import Distortion, pixel_slopes
from splatpilot.systems.splats.splat_camera import empty_scene

# Lamps at infinity: direction and intensity of one overhead, four from the sides so that no wall is
# dark or like its neighbor, one from below for undersides. White that faces up is just not clipped.
_LAMPS = (
    ((0.15, 0.25, -1.0), 0.9),
    ((1.0, 0.15, -0.5), 1.1),
    ((-1.0, -0.15, -0.5), 1.3),
    ((0.15, 1.0, -0.5), 0.9),
    ((-0.15, -1.0, -0.5), 1.5),
    ((0.2, 0.3, 1.0), 0.8),
)
_GLOSS = 0.01  # fraction of white light that VTK's rough surfaces reflect, whatever their color
_SAMPLES = 2  # colors along each side of a pixel, whose mean is its color, without jagged edges
_STEP = 1e-4  # [m], and fraction of depth, from a surface to the start of the search for the next
_HIDDEN = 0.01  # fraction of the light from behind below which the search ends


class MeshImages(NamedTuple):
    """Images of a mesh."""

    color: NDArray[np.uint8]  # (H, W, 3)
    depth: NDArray[np.float32]  # (H, W) [m], along the optical axis; inf without a surface


class MeshRenderer:
    """Renders a mesh: .gltf, .glb, or .obj with its materials.

    Args:
        up: axis of the file that points up, "y" (as glTF says) or "z".
        background: red, green, blue in 0 to 1.
        scale: [m] unit of the file.
    """

    def __init__(self, mesh: Path, up: str, background: Sequence[float], scale: float = 1.0):
        check_mesh(mesh)
        require_opengl()
        lights = [
            LightParameter(type="directional", frame="world", direction=d, intensity=intensity)
            for d, intensity in _LAMPS
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
        with TemporaryDirectory(prefix="splatpilot-") as folder:
            solid = Path(folder, "model.gltf")
            _, self._cut_outs = split(mesh, up, scale, solid)
            if solid.is_file():
                visual = GeometryId.get_new_id(), Mesh(str(solid), scale), properties, X_WM, False
                with readable(mesh, "mesh for Drake"):
                    self._engine.RegisterVisual(*visual)

    def render(
        self,
        X_WC: RigidTransform,
        K: NDArray[np.float64],
        width: int,
        height: int,
        depth_range: tuple[float, float] = (0.05, 150.0),
        with_color: bool = True,
    ) -> MeshImages:
        """Returns the view of a camera at X_WC with intrinsics K (3, 3) [px], in a range of depth
        [m]; black unless `with_color`. Depth is exact, at the centers of pixels."""

        # In OpenGL's image plane, too, the principal point of a symmetric view is width / 2.
        def core(samples: int) -> RenderCameraCore:
            intrinsics = samples * K[[0, 1, 0, 1], [0, 1, 2, 2]]
            info = CameraInfo(samples * width, samples * height, *intrinsics)
            return RenderCameraCore("", info, ClippingRange(*depth_range), RigidTransform())

        depth, color = ImageDepth32F(width, height), np.zeros((height, width, 3), np.uint8)
        self._engine.UpdateViewpoint(X_WC)
        if with_color:
            fine = ImageRgba8U(_SAMPLES * width, _SAMPLES * height)
            self._engine.RenderColorImage(ColorRenderCamera(core(_SAMPLES)), fine)
            color = cv2.resize(
                np.asarray(fine.data)[..., :3], (width, height), interpolation=cv2.INTER_AREA
            )
        self._engine.RenderDepthImage(DepthRenderCamera(core(1), DepthRange(*depth_range)), depth)
        images = MeshImages(color.astype(np.uint8), np.array(depth.data)[..., 0])
        if not self._cut_outs.materials:
            return images
        return _draw(self._cut_outs, images, X_WC, K, depth_range[0])


def shade(albedo: NDArray[np.float64], normal: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns colors (n, 3), 0 to 1, of rough dielectric surfaces as VTK lights them."""
    light = np.zeros(len(normal))
    for direction, intensity in _LAMPS:
        toward = -np.asarray(direction) / np.linalg.norm(direction)
        light += intensity / np.pi * np.maximum(normal @ toward, 0)
    return np.clip((albedo + _GLOSS) * light[:, None], 0, 1) ** (1 / GAMMA)


def _draw(
    cut_outs: CutOuts,
    images: MeshImages,
    X_WC: RigidTransform,
    K: NDArray[np.float64],
    near: float,
) -> MeshImages:
    """Returns the images with surfaces with holes drawn where nothing in them hides these. Depth is
    that of the first surface, opaque or not."""
    if not trimesh.ray.has_embree:
        raise ModuleNotFoundError(
            "textures with holes need embreex, which has no wheel for this processor; use another "
            "machine",
            name="embreex",
        )
    height, width = images.depth.shape
    # Rays have depth 1, so that distances along them are depths.
    v, u = np.mgrid[:height, :width].reshape(2, -1) + 0.5
    rays = np.column_stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], np.ones(len(u))])
    rays = rays @ X_WC.rotation().matrix().T
    p_WC = X_WC.translation()
    depth, color = images.depth.reshape(-1).astype(np.float64), np.zeros((len(rays), 3))
    limit = depth.copy()
    behind, reached = np.ones(len(rays)), np.full(len(rays), near)
    active = np.flatnonzero(limit > near)
    while len(active):
        origins = p_WC + reached[active, None] * rays[active]
        triangle = cut_outs.surface.ray.intersects_first(origins, rays[active])  # -1 for none
        active, triangle = active[triangle >= 0], triangle[triangle >= 0]
        # Intersect again in double precision.
        normal, ray = cut_outs.surface.face_normals[triangle], rays[active]
        slope = (ray * normal).sum(axis=1)
        offset = ((cut_outs.surface.triangles[triangle, 0] - p_WC) * normal).sum(axis=1)
        z = np.maximum(offset / np.where(slope == 0, 1, slope), reached[active])
        seen = z < limit[active]
        active, triangle, z, ray = active[seen], triangle[seen], z[seen], ray[seen]
        albedo, alpha = cut_outs.sample_at(triangle, p_WC + z[:, None] * ray)
        facing = -np.sign(slope[seen])[:, None] * normal[seen]
        share = behind[active] * alpha
        color[active] += share[:, None] * shade(albedo, facing)
        first = (behind[active] == 1) & (alpha > 0)
        depth[active[first]] = z[first]
        behind[active] -= share
        reached[active] = z + _STEP * np.maximum(z, 1)
        active = active[behind[active] > _HIDDEN]
    image = 255 * color.reshape(height, width, 3)
    image += behind.reshape(height, width, 1) * images.color
    return MeshImages(
        np.round(image).clip(0, 255).astype(np.uint8),
        depth.reshape(height, width).astype(np.float32),
    )


_NEAR, _FAR = 0.02, 500.0  # [m], range of depth in which the mesh is drawn
_MAX_SLOPE = 4.0  # of rays of a lens, 76 degrees from the axis


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
        X_WC: RigidTransform,
        near: float = 0.01,
        far: float = 1e10,
        background: Background = BLACK,
        moving: PlacedGaussians = NO_GAUSSIANS,
        distortion: Distortion | None = None,
        max_depth: float = np.inf,
        merged_spread: float = 0.0,
        rows: tuple[int, int] | None = None,
        with_color: bool = True,
    ) -> RenderedView:
        """Renders color and depth; see `BakedScene.render`. The background is that of the mesh, and
        `merged_spread` has no effect."""
        K = np.array(K, dtype=np.float64)
        if rows is not None:
            height = rows[1] - rows[0]
            K[1, 2] -= rows[0]
        camera = K.copy(), width, height, X_WC, near, far
        slopes, size = None, (width, height)
        if distortion is not None:
            # A pinhole camera around all rays of the lens, from which the image is resampled.
            slopes = pixel_slopes(distortion, K, *size)
            lower, upper = np.nanmin(slopes, axis=(0, 1)), np.nanmax(slopes, axis=(0, 1))
            widest = max(-lower.min(), upper.max())
            require(widest < _MAX_SLOPE, "slopes of rays in a mesh", f"< {_MAX_SLOPE}", widest)
            focal = K[[0, 1], [0, 1]]
            K[:2, 2] = 1 - focal * lower
            size = tuple(np.ceil(focal * (upper - lower) + 2).astype(int).tolist())
        span = max(near, _NEAR), min(far, _FAR)
        images = self._renderer.render(X_WC, K, *size, depth_range=span, with_color=with_color)
        color, depth = images
        depth = np.where(np.isfinite(depth), depth, np.float32(0))
        if slopes is not None:
            points = (slopes * K[[0, 1], [0, 1]] + K[:2, 2] - 0.5).astype(np.float32)
            points[np.isnan(points[..., 0])] = -1e6  # outside, where remap fills with 0
            u, v = np.ascontiguousarray(np.moveaxis(points, -1, 0))
            color = np.asarray(cv2.remap(color, u, v, cv2.INTER_LINEAR))
            depth = np.asarray(cv2.remap(depth, u, v, cv2.INTER_NEAREST), np.float32)
        view = RenderedView((color / 255).astype(np.float32), depth, (depth > 0).astype(np.float32))
        if len(moving.means):
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


def _in_front(view: RenderedView, bodies: RenderedView) -> RenderedView:
    """Returns the view with bodies drawn where they are nearer; both on their own backgrounds."""
    nearer = (bodies.depth > 0) & ((view.depth == 0) | (bodies.depth < view.depth))
    over = bodies.color + (1 - bodies.alpha[..., None]) * view.color
    return RenderedView(
        np.where(nearer[..., None], over, view.color).astype(np.float32),
        np.where(nearer, bodies.depth, view.depth),
        np.where(nearer, np.maximum(bodies.alpha, view.alpha), view.alpha),
    )
