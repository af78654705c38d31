"""Renders meshes with Drake's RenderEngineVtk, and surfaces with holes in textures among them."""

from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

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

from splatpilot.diagrams.worlds.mesh import GAMMA, CutOuts, check_mesh, split
from splatpilot.systems.common.extras import require_opengl
from splatpilot.systems.common.readers import readable

MIN_DEPTH, MAX_DEPTH = 0.05, 150.0  # [m], range of the depth images; nearer is 0, farther is inf

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
        check_mesh(mesh, up)
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
        depth_range: tuple[float, float] = (MIN_DEPTH, MAX_DEPTH),
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
        return (
            images
            if self._cut_outs is None
            else _draw(self._cut_outs, images, X_WC, K, depth_range[0])
        )


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
