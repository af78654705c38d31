"""Surfaces whose textures cut holes into them: leaves, fences, grilles; seen by casting rays."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray

from splatpilot.systems.read_limit import require_readable_size
from splatpilot.training.captures.capture import CaptureFrame

GAMMA = 2.2
"""Of textures and images, as VTK has it."""
_GLOSS = 0.01
"""What VTK's rough surfaces reflect of white light, whatever their color."""
_STEP = 1e-4
"""[m], and of the depth, from one surface to where the next is looked for."""
_HIDDEN = 0.01
"""Part of the light from behind below which nothing there is looked for."""


def sample_surface(
    path: Path, surface: trimesh.Trimesh, density: float
) -> tuple[NDArray[np.float64], NDArray[np.intp]]:
    """Returns points (N, 3) [m] on a surface, so many [1/m^2], and the triangle (N,) of each.

    Raises:
        ValueError: if they would take too much memory; the message names the file `path`.
    """
    if not 0 < surface.area < np.inf:
        return np.zeros((0, 3)), np.zeros(0, dtype=np.intp)
    count = int(density * surface.area) + 1
    require_readable_size(path, 64.0 * count)
    points, triangle = trimesh.sample.sample_surface(surface, count, seed=0)[:2]
    return np.asarray(points, dtype=np.float64), np.asarray(triangle)


@dataclass(frozen=True, eq=False)
class CutMaterial:
    """The base color of a surface, and where it is."""

    pixels: NDArray[np.float32]  # (H, W, 4), linear, colors times alpha
    transform: NDArray[np.float64]  # (2, 3), of texture coordinates
    wrap: tuple[str, str]  # repeat, mirror or clamp, across and down
    nearest: bool  # whether texels are not interpolated
    cutoff: float  # alpha from which there is a surface
    translucent: bool  # or opaque

    def at(self, uv: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Returns colors (n, 3), linear, and alphas (n,), 0 where there is no surface.

        Args:
            uv: (n, 2), texture coordinates as glTF has them, from the upper left corner.
        """
        size = np.array(self.pixels.shape[1::-1])
        position = (uv @ self.transform[:, :2].T + self.transform[:, 2]) * size - 0.5
        if self.nearest:
            position = np.round(position)
        first = np.floor(position).astype(int)
        weight = position - first
        found = np.zeros((len(uv), 4))
        for down in (0, 1):
            for across in (0, 1):
                column, row = (
                    _wrapped(first[:, k] + step, size[k], self.wrap[k])
                    for k, step in enumerate((across, down))
                )
                share = np.abs(1 - across - weight[:, 0]) * np.abs(1 - down - weight[:, 1])
                found += share[:, None] * self.pixels[row, column]
        alpha = found[:, 3]
        color = found[:, :3] / np.maximum(alpha, 1e-6)[:, None]
        there = alpha >= self.cutoff
        return color, np.where(there, alpha if self.translucent else 1.0, 0.0)


def _lit(
    albedo: NDArray[np.float64],
    normal: NDArray[np.float64],
    lamps: Sequence[tuple[Sequence[float], float]],
) -> NDArray[np.float64]:
    """Returns colors (n, 3), 0 to 1, of surfaces as VTK lights rough ones that are not metal."""
    light = np.zeros(len(normal))
    for direction, intensity in lamps:
        toward = -np.asarray(direction) / np.linalg.norm(direction)
        light += intensity / np.pi * np.maximum(normal @ toward, 0)
    return np.clip((albedo + _GLOSS) * light[:, None], 0, 1) ** (1 / GAMMA)


def _wrapped(texel: NDArray[np.intp], size: int, wrap: str) -> NDArray[np.intp]:
    if wrap == "clamp":
        return texel.clip(0, size - 1)
    if wrap == "mirror":
        texel = texel % (2 * size)
        return np.minimum(texel, 2 * size - 1 - texel)
    return texel % size


@dataclass(frozen=True, eq=False)
class CutOuts:
    """Triangles with holes."""

    triangles: NDArray[np.float64]  # (T, 3, 3) [m], corners in W
    uv: NDArray[np.float64]  # (T, 3, 2)
    material: NDArray[np.intp]  # (T,)
    materials: Sequence[CutMaterial]

    @cached_property
    def _scene(self) -> Any:
        try:
            from embreex.mesh_construction import TriangleMesh
            from embreex.rtcore_scene import EmbreeScene
        except ModuleNotFoundError:
            raise ModuleNotFoundError(
                "textures that cut holes need embreex, of which there is no wheel for this "
                "processor; render the capture on another machine",
                name="embreex",
            ) from None
        scene = EmbreeScene()
        TriangleMesh(scene, self.triangles.astype(np.float32))
        return scene

    @cached_property
    def _normals(self) -> NDArray[np.float64]:
        a, b, c = np.moveaxis(self.triangles, 1, 0)
        normals = np.cross(b - a, c - a)
        return normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)

    def _at(
        self, triangle: NDArray[np.intp], weights: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Returns colors (n, 3) and alphas (n,) of points by their barycentric weights (n, 3)."""
        uv = (weights[..., None] * self.uv[triangle]).sum(axis=1)
        color, alpha = np.zeros((len(uv), 3)), np.zeros(len(uv))
        for i, material in enumerate(self.materials):
            own = self.material[triangle] == i
            color[own], alpha[own] = material.at(uv[own])
        return color, alpha

    def sample(self, path: Path, density: float) -> NDArray[np.float64]:
        """Returns points (N, 3) [m] that are in no hole; see `sample_surface`."""
        faces = np.arange(3 * len(self.triangles)).reshape(-1, 3)
        surface = trimesh.Trimesh(self.triangles.reshape(-1, 3), faces, process=False)
        points, triangle = sample_surface(path, surface, density)
        weights = trimesh.triangles.points_to_barycentric(self.triangles[triangle], points)
        return points[self._at(triangle, weights)[1] > 0]

    def draw(
        self, frame: CaptureFrame, near: float, lamps: Sequence[tuple[Sequence[float], float]]
    ) -> CaptureFrame:
        """Returns the frame with these surfaces in it, where nothing in it hides them.

        Depth is that of the first surface, opaque or not.

        Args:
            near: [m], depth from which on surfaces are seen.
            lamps: direction of the light, and its intensity.
        """
        height, width = frame.depth.shape
        v, u = np.mgrid[:height, :width] + 0.5
        # Their depth is 1, so that distances along them are depths.
        rays = frame.back_project(u, v, np.ones_like(u)).reshape(-1, 3)
        rays = rays @ frame.X_WC.rotation().matrix().T
        p_WC = frame.X_WC.translation()
        depth, color = frame.depth.reshape(-1).astype(np.float64), np.zeros((len(rays), 3))
        limit = depth.copy()
        behind, reached = np.ones(len(rays)), np.full(len(rays), near)
        active = np.flatnonzero(limit > near)
        while len(active):
            triangle = self._first(p_WC + reached[active, None] * rays[active], rays[active])
            active, triangle = active[triangle >= 0], triangle[triangle >= 0]
            # Again in double precision.
            normal, ray = self._normals[triangle], rays[active]
            slope = (ray * normal).sum(axis=1)
            offset = ((self.triangles[triangle, 0] - p_WC) * normal).sum(axis=1)
            z = np.maximum(offset / np.where(slope == 0, 1, slope), reached[active])
            seen = z < limit[active]
            active, triangle, z, ray = active[seen], triangle[seen], z[seen], ray[seen]
            weights = trimesh.triangles.points_to_barycentric(
                self.triangles[triangle], p_WC + z[:, None] * ray
            )
            albedo, alpha = self._at(triangle, weights)
            facing = -np.sign(slope[seen])[:, None] * normal[seen]
            share = behind[active] * alpha
            color[active] += share[:, None] * _lit(albedo, facing, lamps)
            first = (behind[active] == 1) & (alpha > 0)
            depth[active[first]] = z[first]
            behind[active] -= share
            reached[active] = z + _STEP * np.maximum(z, 1)
            active = active[behind[active] > _HIDDEN]
        image = 255 * color.reshape(height, width, 3)
        image += behind.reshape(height, width, 1) * frame.image
        return replace(
            frame,
            image=np.round(image).clip(0, 255).astype(np.uint8),
            depth=depth.reshape(height, width).astype(np.float32),
        )

    def _first(self, origins: NDArray[np.float64], rays: NDArray[np.float64]) -> NDArray[np.intp]:
        """Returns the first triangle (n,) that each ray meets, -1 for none."""
        found = self._scene.run(
            origins.astype(np.float32), rays.astype(np.float32), query="INTERSECT"
        )
        return np.asarray(found, dtype=np.intp)
