"""What cameras see of many worlds and how near points are to them, by native code.

Nothing here is differentiable: images carry no gradient, and the gradient of a distance is the
normal that is returned with it. Tensors may be on any device; what is asked is computed on the CPU.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple, Protocol

import numpy as np
import torch
from torch import Tensor

from splatpilot import _native
from splatpilot.systems.collision.esdf import Esdf
from splatpilot.systems.collision.shapes import Shape, shape_rows


class PixelRays(NamedTuple):
    """The rays of a small depth camera that looks along body x."""

    directions_C: np.ndarray  # (R, 3) float32, camera frame, z = 1, row by row
    half_pixel: float  # half the width of a pixel at depth 1; of oblong ones, of their mean width

    @classmethod
    def of(cls, width: int, height: int, fov_x: float, cell_aspect: float = 1.0) -> "PixelRays":
        """The camera of `width` x `height` pixels, `cell_aspect` times as high as wide.

        `fov_x` is the horizontal field of view [deg].
        """
        half = math.tan(math.radians(0.5 * fov_x)) / width
        x = half * (2 * np.arange(width) + 1 - width)
        y = half * cell_aspect * (2 * np.arange(height) + 1 - height)
        directions = np.ones((height, width, 3), np.float32)
        directions[..., 0], directions[..., 1] = x, y[:, None]
        return cls(directions.reshape(-1, 3), 0.5 * half * (1.0 + cell_aspect))


class Geometry(Protocol):
    """The surfaces of several worlds. Row n of each query is about world `world[n]`, (N,) int64."""

    def depth(self, p_WC: Tensor, R_WC: Tensor, rays: PixelRays, world: Tensor) -> Tensor:
        """Planar depth (N, R) [m] from cameras at p_WC (N, 3) [m], infinite where nothing is.

        A pixel sees what any part of it sees, as in the least of a finer image: surfaces are hit by
        rays that pass within half a pixel, at the depth where the widened surface begins plus what
        it was widened by.
        """
        ...

    def nearest(self, p_WQ: Tensor, world: Tensor, count: int) -> tuple[Tensor, Tensor]:
        """Signed distances (N, K) [m] at p_WQ (N, 3) [m] of the K <= `count` nearest obstacles,
        nearest first, and their gradients (N, K, 3); infinite and 0 for those that there are not.
        """
        ...


class ShapeGeometry:
    """Worlds of analytic shapes, exactly those that the benchmark's worlds are made of.

    Args:
      worlds: the shapes of each.
      threads: cores that images are cast on; the images are the same for any number.
      simd: the instructions used, of `_native.simd_levels()`, which all give the same; by default
        the widest.

    Raises:
      ValueError: on a shape out of range, or a query about a world that there is not.
    """

    def __init__(self, worlds: Sequence[Sequence[Shape]], threads: int = 1, simd: str = "") -> None:
        rows, kinds = shape_rows([shape for world in worlds for shape in world])
        self._native = _native.ShapeWorlds(
            shapes=rows.astype(np.float32),
            kinds=kinds,
            first=np.cumsum([0, *map(len, worlds)]),
            threads=threads,
            simd=simd,
        )

    def depth(self, p_WC: Tensor, R_WC: Tensor, rays: PixelRays, world: Tensor) -> Tensor:
        return _depth(self._native, p_WC, R_WC, rays, world)

    def nearest(self, p_WQ: Tensor, world: Tensor, count: int) -> tuple[Tensor, Tensor]:
        return _query(self._native.nearest, p_WQ, world, count)


class Grids:
    """Values over the voxels of several worlds, interpolated trilinearly.

    Args:
      values: (nx, ny, nz) of each, at the centers of voxels, at least two along each axis.
      lower_W: (W, 3) [m], lower corners.
      voxel_sizes: (W,) [m].
      threads, simd: see `ShapeGeometry`.

    Raises:
      ValueError: on grids out of range, or a query about a world that there is not.
    """

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
        """Values (N,) and gradients (N, 3) [1/m] at p_WQ (N, 3) [m]; beyond the outermost centers
        of voxels those at the nearest point between them."""
        return _query(self._native.interpolate, p_WQ, world)


class EsdfGeometry(Grids):
    """Worlds known by their distance fields, as captured ones are; each is one obstacle.

    Where a field counts unknown space and its bounds as occupied, cameras see them so too.

    Args:
      fields: one for each world.
      threads, simd: see `ShapeGeometry`.
    """

    def __init__(self, fields: Sequence[Esdf], threads: int = 1, simd: str = "") -> None:
        super().__init__(
            [field.distances for field in fields],
            [field.lower_W for field in fields],
            [field.voxel_size for field in fields],
            threads,
            simd,
        )

    def depth(self, p_WC: Tensor, R_WC: Tensor, rays: PixelRays, world: Tensor) -> Tensor:
        return _depth(self._native, p_WC, R_WC, rays, world)

    def nearest(self, p_WQ: Tensor, world: Tensor, count: int) -> tuple[Tensor, Tensor]:
        distances, gradients = self.interpolate(p_WQ, world)
        return distances[:, None], gradients[:, None]


class MixedGeometry:
    """Worlds of shapes beside worlds of distance fields; those that share a field hold it once.

    Args:
      worlds: the shapes of each, or its distance field.
      threads, simd: see `ShapeGeometry`.
    """

    def __init__(
        self, worlds: Sequence[Sequence[Shape] | Esdf], threads: int = 1, simd: str = ""
    ) -> None:
        shapes = [world for world in worlds if not isinstance(world, Esdf)]
        fields = list({id(world): world for world in worlds if isinstance(world, Esdf)}.values())
        self._parts: list[Geometry] = [ShapeGeometry(shapes, threads, simd)]
        if fields:
            self._parts.append(EsdfGeometry(fields, threads, simd))
        self._part = torch.tensor([isinstance(world, Esdf) for world in worlds], dtype=torch.long)
        of_shapes, of_field = iter(range(len(shapes))), {id(f): n for n, f in enumerate(fields)}
        self._number = torch.tensor(
            [of_field[id(w)] if isinstance(w, Esdf) else next(of_shapes) for w in worlds]
        )

    def depth(self, p_WC: Tensor, R_WC: Tensor, rays: PixelRays, world: Tensor) -> Tensor:
        depth = p_WC.new_empty(len(p_WC), len(rays.directions_C))
        for part, rows, number in self._rows(world):
            depth[rows] = part.depth(p_WC[rows], R_WC[rows], rays, number)
        return depth

    def nearest(self, p_WQ: Tensor, world: Tensor, count: int) -> tuple[Tensor, Tensor]:
        distances = p_WQ.new_full((len(p_WQ), count), torch.inf)
        gradients = p_WQ.new_zeros(len(p_WQ), count, 3)
        for part, rows, number in self._rows(world):
            d, gradient = part.nearest(p_WQ[rows], number, count)
            distances[rows, : d.shape[1]], gradients[rows, : d.shape[1]] = d, gradient
        return distances, gradients

    def _rows(self, world: Tensor) -> Iterator[tuple[Geometry, Tensor, Tensor]]:
        """Of each part that is asked, the rows of a query and the numbers of their worlds there."""
        asked = self._part.to(world.device)[world]
        for number, part in enumerate(self._parts):
            rows = (asked == number).nonzero()[:, 0]
            if len(rows):
                yield part, rows, self._number.to(world.device)[world[rows]]


def _depth(
    worlds: _native.ShapeWorlds | _native.GridWorlds,
    p_WC: Tensor,
    R_WC: Tensor,
    rays: PixelRays,
    world: Tensor,
) -> Tensor:
    depth = torch.empty(len(p_WC), len(rays.directions_C))
    worlds.depth(
        p_WC=_array(p_WC),
        R_WC=_array(R_WC),
        world=_array(world),
        directions_C=rays.directions_C,
        half_pixel=rays.half_pixel,
        depth=depth.numpy(),
    )
    return depth.to(p_WC.device)


def _query(
    answer: Callable[..., None], p_WQ: Tensor, world: Tensor, *shape: int
) -> tuple[Tensor, Tensor]:
    """Values (N, *shape) and their gradients (N, *shape, 3) at p_WQ, as `answer` writes them."""
    values, gradients = torch.empty(len(p_WQ), *shape), torch.empty(len(p_WQ), *shape, 3)
    answer(
        p_WQ=_array(p_WQ),
        world=_array(world),
        values=values.numpy(),
        gradients=gradients.numpy(),
    )
    return values.to(p_WQ.device), gradients.to(p_WQ.device)


def _array(tensor: Tensor) -> np.ndarray:
    return tensor.detach().cpu().contiguous().numpy()
