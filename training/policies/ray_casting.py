"""Depth images of many worlds, and distances to their surfaces, by native code.

Not differentiable: images have no gradient, and the gradients of distances are returned with them.
Tensors may be on any device; the native code runs on the CPU.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from splatpilot import _native
from splatpilot.systems.collision.esdf import Esdf
from splatpilot.systems.collision.shapes import Shape, shape_rows


class PixelRays(NamedTuple):
    """The rays of a small depth camera that looks along body x."""

    directions_C: np.ndarray  # (R, 3) float32, camera frame, z = 1, row by row
    half_pixel: float  # half of the mean of a pixel's width and height at depth 1

    @classmethod
    def of(cls, width: int, height: int, fov_x: float, cell_aspect: float = 1.0) -> "PixelRays":
        """Returns the rays of `width` x `height` pixels, `cell_aspect` times as high as wide, with
        the horizontal field of view `fov_x` [deg]."""
        half = math.tan(math.radians(0.5 * fov_x)) / width
        x = half * (2 * np.arange(width) + 1 - width)
        y = half * cell_aspect * (2 * np.arange(height) + 1 - height)
        directions = np.ones((height, width, 3), np.float32)
        directions[..., 0], directions[..., 1] = x, y[:, None]
        return cls(directions.reshape(-1, 3), 0.5 * half * (1.0 + cell_aspect))


class Geometry:
    """The surfaces of several worlds. Row n of each query is about world `world[n]`, (N,) int64."""

    _native: Any  # `_native.ShapeWorlds` or `_native.GridWorlds`

    def depth(self, p_WC: Tensor, R_WC: Tensor, rays: PixelRays, world: Tensor) -> Tensor:
        """Renders planar depth (N, R) [m] from p_WC (N, 3) [m]; inf without a surface. Rays hit
        surfaces within half a pixel, at the depth of the widened surface plus half its width."""
        depth = torch.empty(len(p_WC), len(rays.directions_C))
        poses = {"p_WC": _array(p_WC), "R_WC": _array(R_WC), "world": _array(world)}
        self._native.depth(**poses, **rays._asdict(), depth=depth.numpy())
        return depth.to(p_WC.device)

    def nearest(self, p_WQ: Tensor, world: Tensor, count: int) -> tuple[Tensor, Tensor]:
        """Computes signed distances (N, K) [m] at p_WQ (N, 3) [m] to the K <= `count` nearest
        obstacles, nearest first, and their gradients (N, K, 3); inf and 0 if there are fewer."""
        raise NotImplementedError


class ShapeGeometry(Geometry):
    """Worlds of analytic shapes; results are equal for all `threads` and instructions `simd`."""

    def __init__(self, worlds: Sequence[Sequence[Shape]], threads: int = 1, simd: str = "") -> None:
        rows, kinds = shape_rows([shape for world in worlds for shape in world])
        self._native = _native.ShapeWorlds(
            shapes=rows.astype(np.float32),
            kinds=kinds,
            first=np.cumsum([0, *map(len, worlds)]),
            threads=threads,
            simd=simd,
        )

    def nearest(self, p_WQ: Tensor, world: Tensor, count: int) -> tuple[Tensor, Tensor]:
        return _query(self._native.nearest, p_WQ, world, count)


class Grids:
    """Grids (nx, ny, nz) of values at the centers of voxels, interpolated trilinearly."""

    def __init__(
        self,
        values: Sequence[np.ndarray],
        lower_W: Sequence[np.ndarray] | np.ndarray,
        voxel_sizes: Sequence[float] | np.ndarray,
        threads: int = 1,
        simd: str = "",
    ) -> None:
        self._native = _native.GridWorlds(
            values=np.concatenate([np.ravel(grid) for grid in values], dtype=np.float32),
            shapes=np.array([grid.shape for grid in values], np.int64),
            lower_W=np.array(lower_W, np.float32),
            voxel_sizes=np.array(voxel_sizes, np.float32),
            threads=threads,
            simd=simd,
        )

    def interpolate(self, p_WQ: Tensor, world: Tensor) -> tuple[Tensor, Tensor]:
        """Interpolates values (N,) and gradients (N, 3) at p_WQ (N, 3) [m]; constant outside."""
        return _query(self._native.interpolate, p_WQ, world)


class EsdfGeometry(Geometry, Grids):
    """Worlds given by distance fields; each is one obstacle. Occupied unknown space is visible."""

    def __init__(self, fields: Sequence[Esdf], threads: int = 1, simd: str = "") -> None:
        values = [field.distances for field in fields]
        lower_W = [field.lower_W for field in fields]
        super().__init__(values, lower_W, [field.voxel_size for field in fields], threads, simd)

    def nearest(self, p_WQ: Tensor, world: Tensor, count: int) -> tuple[Tensor, Tensor]:
        distances, gradients = self.interpolate(p_WQ, world)
        return distances[:, None], gradients[:, None]


class MixedGeometry(Geometry):
    """Worlds of shapes or distance fields; a field that worlds share is stored once."""

    def __init__(self, worlds: Sequence[Sequence[Shape] | Esdf]) -> None:
        shapes = [world for world in worlds if not isinstance(world, Esdf)]
        fields = list({id(world): world for world in worlds if isinstance(world, Esdf)}.values())
        self._parts: list[Geometry] = [ShapeGeometry(shapes)]
        if fields:
            self._parts.append(EsdfGeometry(fields))
        self._part = torch.tensor([isinstance(world, Esdf) for world in worlds], dtype=torch.long)
        of_shapes, of_field = iter(range(len(shapes))), {id(f): n for n, f in enumerate(fields)}
        self._index = torch.tensor(
            [of_field[id(w)] if isinstance(w, Esdf) else next(of_shapes) for w in worlds]
        )

    def depth(self, p_WC: Tensor, R_WC: Tensor, rays: PixelRays, world: Tensor) -> Tensor:
        depth = p_WC.new_empty(len(p_WC), len(rays.directions_C))
        for part, rows, index in self._rows(world):
            depth[rows] = part.depth(p_WC[rows], R_WC[rows], rays, index)
        return depth

    def nearest(self, p_WQ: Tensor, world: Tensor, count: int) -> tuple[Tensor, Tensor]:
        distances = p_WQ.new_full((len(p_WQ), count), torch.inf)
        gradients = p_WQ.new_zeros(len(p_WQ), count, 3)
        for part, rows, index in self._rows(world):
            d, gradient = part.nearest(p_WQ[rows], index, count)
            distances[rows, : d.shape[1]], gradients[rows, : d.shape[1]] = d, gradient
        return distances, gradients

    def _rows(self, world: Tensor) -> Iterator[tuple[Geometry, Tensor, Tensor]]:
        """Yields each part of a query, its rows and the indices of their worlds in the part."""
        queried = self._part.to(world.device)[world]
        for number, part in enumerate(self._parts):
            rows = (queried == number).nonzero()[:, 0]
            if len(rows):
                yield part, rows, self._index.to(world.device)[world[rows]]


def _query(
    function: Callable[..., None], p_WQ: Tensor, world: Tensor, *shape: int
) -> tuple[Tensor, Tensor]:
    """Calls native code for values (N, *shape) and their gradients (N, *shape, 3) at p_WQ."""
    values, gradients = torch.empty(len(p_WQ), *shape), torch.empty(len(p_WQ), *shape, 3)
    outputs = {"values": values.numpy(), "gradients": gradients.numpy()}
    function(p_WQ=_array(p_WQ), world=_array(world), **outputs)
    return values.to(p_WQ.device), gradients.to(p_WQ.device)


def _array(tensor: Tensor) -> np.ndarray:
    return tensor.detach().cpu().contiguous().numpy()
