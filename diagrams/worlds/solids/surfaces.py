"""Surfels: flat Gaussians on surfaces."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields, replace
from typing import Self

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from splatpilot.systems.splats.scene import GaussianScene, concatenated


@dataclass(frozen=True, eq=False)
class FloorPlan:
    """A flyable volume above the ground z = 0."""

    lower: NDArray[np.float64]  # (3,) [m], in W
    upper: NDArray[np.float64]  # (3,) [m]

    @classmethod
    def of_size(cls, length: float, width: float, height: float) -> FloorPlan:
        """Returns the volume from x = 0 to length, centered on y = 0, all in [m]."""
        return cls(np.array([0.0, -width / 2, 0.0]), np.array([length, width / 2, height]))

    def outside(self, p: ArrayLike) -> NDArray[np.float64]:
        """Computes horizontal distances (N,) [m] of p (N, 2 or more) from the volume, 0 inside."""
        p = np.asarray(p)[:, :2]
        beyond = np.maximum(self.lower[:2] - p, p - self.upper[:2])
        return np.linalg.norm(np.clip(beyond, 0, None), axis=1)

    def is_faced(self, p: NDArray, n: NDArray) -> NDArray[np.bool_]:
        """Marks surfaces at p (N, 3) [m] with normals n (N, 3) that face a point of the volume."""
        corner = np.where(n > 0, self.upper, self.lower)
        return np.einsum("nk,nk->n", n, corner - p) > 1e-9


# Standard deviation over spacing at which a layer of splats has no holes.
COVERAGE = 0.62
THICKNESS = 0.001  # [m], standard deviation of a splat across its surface

# [standard deviations] from the centers of the outermost patches to the edge of a layer, where two
# layers that meet are half opaque.
RIM = 1.9
_BULGE = 2.0  # the same of flat patches around a curved surface, which overlap along its outline
_RINGS = 0.5, 4.0, 9.0, 16.0, 28.0  # [m], from the volume to the outer edges of rings of ground
GROUND_REACH = _RINGS[-1]  # [m], width of the ground around the volume


@dataclass(frozen=True, eq=False)
class Surfels:
    """N elliptic patches of surface in W, without color."""

    p: NDArray[np.float64]  # (N, 3) [m], centers
    n: NDArray[np.float64]  # (N, 3), unit normals, outwards
    t: NDArray[np.float64]  # (N, 3), unit directions of the first extent, in the surface
    extent: NDArray[np.float64]  # (N, 2) [m], standard deviations along t and along n x t

    def __len__(self) -> int:
        return len(self.p)

    def __getitem__(self, rows: ArrayLike) -> Self:
        """Selects patches by a mask or indices."""
        return type(self)(*(getattr(self, f.name)[rows] for f in fields(self)))

    @classmethod
    def concatenate(cls, parts: list[Surfels]) -> Surfels:
        """Joins the patches of `parts`."""
        return cls(*(np.concatenate([getattr(s, f.name) for s in parts]) for f in fields(cls)))


def to_gaussians(surfels: Surfels, colors: ArrayLike, opacity: ArrayLike) -> GaussianScene:
    """Converts patches to Gaussians of `colors` (N, 3), sRGB, and `opacity`, a number or (N,)."""
    N = len(surfels)
    R_WP = np.stack([surfels.t, np.cross(surfels.n, surfels.t), surfels.n], axis=-1)
    return GaussianScene.from_colors(
        means=surfels.p,
        quats=Rotation.from_matrix(R_WP).as_quat(scalar_first=True),
        scales=np.column_stack([surfels.extent, np.full(N, THICKNESS)]),
        opacities=np.broadcast_to(opacity, N),
        colors=np.clip(colors, 0, 1),
    )


def merge(scenes: list[GaussianScene]) -> GaussianScene:
    """Joins scenes."""
    return GaussianScene(**concatenated(scenes))


def perpendicular(d: ArrayLike) -> NDArray[np.float64]:
    """Returns a unit vector (..., 3) perpendicular to each d (..., 3)."""
    d = np.asarray(d, dtype=np.float64)
    helper = np.where(np.abs(d[..., 2:]) < 0.9, (0.0, 0.0, 1.0), (1.0, 0.0, 0.0))
    v = np.cross(helper, d)
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def _perpendicular_to_one(d: NDArray[np.float64]) -> NDArray[np.float64]:
    """Computes `perpendicular` of a single vector (3,), ten times as fast."""
    v = np.cross(np.array((0.0, 0.0, 1.0) if abs(d[2]) < 0.9 else (1.0, 0.0, 0.0)), d)
    x, y, z = v.tolist()
    return v / math.sqrt(x * x + y * y + z * z)


def rectangle(
    lower: ArrayLike, upper: ArrayLike, spacing: float, rng: np.random.Generator
) -> NDArray[np.float64]:
    """Samples points (N, 2) on a jittered triangular grid that fills [lower, upper] in a plane."""
    lower, upper = np.asarray(lower, dtype=np.float64), np.asarray(upper, dtype=np.float64)
    row_spacing = spacing * np.sqrt(3) / 2
    n = np.maximum(np.ceil((upper - lower) / (spacing, row_spacing)).astype(int), 1)
    i, j = np.meshgrid(np.arange(n[0]), np.arange(n[1]), indexing="ij")
    cells = np.stack([i + 0.5 * (j % 2) + 0.25, j + 0.5], axis=-1).reshape(-1, 2)
    return lower + (cells + rng.uniform(-0.22, 0.22, cells.shape)) * (upper - lower) / n


def ground_rings(
    plan: FloorPlan, spacings: Sequence[float], rng: np.random.Generator
) -> Iterator[NDArray[np.float64]]:
    """Samples the ground of a volume and of five rings around it: points (N, 2) of each, at its
    spacing [m]."""
    lower, upper = plan.lower[:2], plan.upper[:2]
    inner = 0.0
    for outer, spacing in zip(_RINGS, spacings, strict=True):
        p = rectangle(lower - outer, upper + outer, spacing, rng)
        yield p[plan.outside(p) >= inner]
        inner = outer


def on_ground(p: ArrayLike, angle: ArrayLike, extent: ArrayLike, height: ArrayLike) -> Surfels:
    """Lays patches flat at p (N, 2) and `height` [m], with the first extent at `angle` (N,) [rad]
    from x toward y; extents are (N, 2) or (2,) [m]."""
    p, angle = np.asarray(p, dtype=np.float64), np.asarray(angle, dtype=np.float64)
    N, zeros = len(p), np.zeros(len(p))
    return Surfels(
        p=np.column_stack([p, np.broadcast_to(height, N)]),
        n=np.tile((0.0, 0.0, 1.0), (N, 1)),
        t=np.column_stack([np.cos(angle), np.sin(angle), zeros]),
        extent=np.broadcast_to(extent, (N, 2)),
    )


def widest(radius: float, inset: float) -> float:
    """Computes the maximum spacing [m] of flat patches at most `inset` [m] inside a curved surface
    for which they are half opaque at its outline; radius [m] of curvature."""
    return float(np.sqrt(2 * radius * min(inset, 0.3 * radius)) / (_BULGE * COVERAGE))


def inset(surfels: Surfels, across: NDArray[np.float64], radius: ArrayLike) -> Surfels:
    """Moves flat patches on a surface of a radius [m] of curvature inwards so that they do not
    widen its outline; `across` (N,) [m] are their standard deviations along the curvature."""
    radius = np.asarray(radius, dtype=np.float64)
    bulge = np.minimum(_BULGE * across, 0.8 * radius)
    depth = radius - np.sqrt(radius**2 - bulge**2)
    return replace(surfels, p=surfels.p - depth[:, None] * surfels.n)


def tube(
    p_A: ArrayLike,
    p_B: ArrayLike,
    radius: float,
    spacing: tuple[float, float],
    rng: np.random.Generator,
    taper: float = 1.0,
) -> Surfels:
    """Covers the side of the cylinder from p_A to p_B (3,) with staggered columns of patches, first
    extent along the axis; spacing [m] around and along it, radius at p_B over that at p_A `taper`.
    """
    p_A, p_B = np.asarray(p_A, dtype=np.float64), np.asarray(p_B, dtype=np.float64)
    length = float(np.linalg.norm(p_B - p_A))
    axis = (p_B - p_A) / length
    columns = max(6, round(2 * np.pi * radius / spacing[0]))
    rows = max(1, round(length / spacing[1]))
    i, j = np.meshgrid(np.arange(columns), np.arange(rows), indexing="ij")
    jitter = rng.uniform(-0.25, 0.25, (2, columns, rows))
    offset = rng.uniform(-0.5, 0.5, (columns, 1))  # of columns, to avoid rings
    angle = ((i + jitter[0]) * (2 * np.pi / columns)).ravel()
    s = np.clip((j + 0.5 + offset + jitter[1]) / rows, 0, 1).ravel()
    width = 1 + (taper - 1) * s
    e_1 = _perpendicular_to_one(axis)
    normal = np.outer(np.cos(angle), e_1) + np.outer(np.sin(angle), np.cross(axis, e_1))
    across = COVERAGE * 2 * np.pi * radius / columns
    return Surfels(
        p=p_A + np.outer(s * length, axis) + (radius * width)[:, None] * normal,
        n=normal,
        t=np.tile(axis, (len(s), 1)),
        extent=np.column_stack([np.full(len(s), COVERAGE * length / rows), across * width]),
    )


def even_directions(count: int) -> NDArray[np.float64]:
    """Returns unit vectors (count, 3) along a spiral of golden angles, from z to -z."""
    k = np.arange(count)
    z = 1 - (2 * k + 1) / count
    angle, ring = k * np.pi * (3 - np.sqrt(5)), np.sqrt(1 - z * z)
    return np.column_stack([ring * np.cos(angle), ring * np.sin(angle), z])


def sphere(p_C: ArrayLike, radius: float, spacing: float) -> Surfels:
    """Covers the sphere about p_C (3,) evenly."""
    N = max(12, round(4 * np.pi * radius**2 / spacing**2))
    normal = even_directions(N)
    return Surfels(
        p=np.asarray(p_C) + radius * normal,
        n=normal,
        t=perpendicular(normal),
        extent=np.full((N, 2), COVERAGE * spacing),
    )
