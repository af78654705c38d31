"""Solids: shapes of a material. Gaussians and meshes are drawn from faces of their surface, each
with coordinates (u, v) in meters."""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial

import numpy as np
from numpy.typing import NDArray

from splatpilot.diagrams.worlds.solids import patterns
from splatpilot.diagrams.worlds.solids.surfaces import GROUND_REACH, FloorPlan, perpendicular
from splatpilot.diagrams.worlds.solids.textures import BIRCH, OAK, PINE, Illumination
from splatpilot.systems.collision import shapes
from splatpilot.systems.collision.esdf import Esdf
from splatpilot.systems.common.validation import require
from splatpilot.systems.splats.scene import GaussianScene


@dataclass(frozen=True)
class Marks:
    """Thin patches in front of a closed layer: joints, plates of bark, leaves."""

    cell: tuple[float, float]  # [m], spacing along u and v
    fill: tuple[float, float]  # standard deviation along u and v, over the spacing
    first: tuple[float, float] = (0.5, 0.5)  # position of the first, over the spacing
    jitter: float = 0.0  # largest displacement, over the spacing


@dataclass(frozen=True)
class Material:
    """A surface's colors and the spacing of the Gaussians that show them."""

    albedo: patterns.Pattern
    spacing: float  # [m], of the closed layer, in mean colors of the pattern
    marks: tuple[Marks, ...] = ()  # in front of it, in the pattern's own colors


def _joints(width: float, height: float, line: float, bond: bool = False) -> tuple[Marks, ...]:
    """Returns lines of standard deviation `line` [m] between the cells of a pattern; `bond` shifts
    every other course by half a cell."""
    n = max(1, round(width / 0.25)), max(1, round(height / 0.25))
    beds = Marks((width / n[0], height), (0.55, line / height), (0.5, 1.0))
    if not bond:
        return beds, Marks((width, height / n[1]), (line / width, 0.55), (1.0, 0.5))
    size = line / width, 0.25
    two = width, 2 * height
    return beds, Marks(two, size, (1.0, 0.25)), Marks(two, size, (0.5, 0.75))


_PLATES = (Marks((0.07, 0.18), (0.42, 0.42), jitter=0.35),)
_LEAVES = (Marks((0.12, 0.12), (0.36, 0.20), jitter=0.45),)

MATERIALS: dict[str, Material] = {
    "brick": Material(patterns.brick, 0.15, _joints(*patterns.BRICK, 0.007, bond=True)),
    "concrete": Material(patterns.concrete, 0.16, _joints(2.4, 1.2, 0.012)),
    "wood": Material(patterns.wood, 0.12, _joints(0.18, 1.6, 0.006)),
    "metal": Material(patterns.metal, 0.10),
    "hazard": Material(patterns.hazard, 0.10),
    "signage": Material(patterns.signage, 0.024),
    "plaster": Material(patterns.plaster, 0.14),
    "tiles": Material(patterns.tiles, 0.14, _joints(0.5, 0.5, 0.007)),
    "ceiling": Material(patterns.ceiling, 0.17, _joints(1.2, 0.6, 0.010)),
    "foliage": Material(patterns.foliage, 0.13, _LEAVES),
    "grass": Material(patterns.grass, 0.16, (Marks((0.17, 0.17), (0.30, 0.13), jitter=0.45),)),
    "paving": Material(patterns.paving, 0.18, _joints(0.8, 0.8, 0.012, bond=True)),
    "forest_floor": Material(patterns.forest_floor, 0.15),
    "stone": Material(patterns.stone, 0.08),
    "cable": Material(patterns.cable, 0.06),
    "fabric": Material(patterns.fabric, 0.07),
    "crate": Material(patterns.crate, 0.085),
    "oak": Material(partial(patterns.bark, OAK), 0.12, _PLATES),
    "pine": Material(partial(patterns.bark, PINE), 0.12, _PLATES),
    "birch": Material(partial(patterns.bark, BIRCH), 0.10),
}

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Solid:
    """A shape in W and its material."""

    shape: shapes.Shape
    material: str  # a key of `MATERIALS`
    seed: int = 0  # of the part and tone of the material

    def __post_init__(self) -> None:
        known = self.material in MATERIALS
        require(known, "material", f"one of {', '.join(MATERIALS)}", repr(self.material))

    def albedo(self, uv: Array, p_W: Array) -> NDArray[np.floating]:
        """Returns colors (N, 3), sRGB, of points p_W (N, 3) [m] with face coordinates uv (N, 2)."""
        return MATERIALS[self.material].albedo(uv, self._in_own_frame(p_W), self.seed)

    def _in_own_frame(self, p_W: Array) -> Array:
        """Converts points (N, 3) to the solid's frame, z along its axis, shifted by its seed."""
        shape = self.shape
        shift = 7.3 * np.array([self.seed % 61, self.seed % 53, 0.0])
        match shape:
            case shapes.Sphere():
                return p_W - np.asarray(shape.p_WO) + shift
            case shapes.Box():
                return shape.X_WO.inverse().multiply(p_W.T).T + shift
            case shapes.Capsule() | shapes.Cylinder():
                p_WA = np.asarray(shape.p_WA, dtype=float)
                e_1, e_2, axis, _ = _axes(shape)
                return (p_W - p_WA) @ np.column_stack([e_1, e_2, axis]) + shift
            case shapes.HalfSpace():
                return p_W


@dataclass(frozen=True, eq=False)
class Face:
    """A piece of surface with coordinates u from 0 to size[0] and v from 0 to size[1] [m]."""

    size: tuple[float, float]
    # Maps uv (N, 2) to points (N, 3), unit normals (N, 3) and unit directions of u (N, 3), in W;
    # coordinates beyond the face are extrapolated or clipped.
    at: Callable[[Array], tuple[Array, Array, Array]]
    curved: tuple[float, float] = (np.inf, np.inf)  # [m], radii of curvature along u and v
    round: bool = False  # a disc or part of a sphere, on which lines of constant u meet


def cut_faces(shape: shapes.Shape, lower: Array, upper: Array) -> list[Face]:
    """Cuts the surface of `shape` into faces. A half space must be horizontal; its face ends
    `GROUND_REACH` beyond [lower, upper] (3,)."""
    x, y, z = np.eye(3)
    match shape:
        case shapes.Sphere():
            return [_dome(np.asarray(shape.p_WO, float), x, z, shape.radius, -1.0)]
        case shapes.Box():
            return _box_faces(shape)
        case shapes.Capsule() | shapes.Cylinder():
            e_1, _, axis, length = _axes(shape)
            p_WA, p_WB = np.asarray(shape.p_WA, float), np.asarray(shape.p_WB, float)
            end = _dome if isinstance(shape, shapes.Capsule) else _disc
            return [
                _side(p_WA, e_1, axis, shape.radius, length),
                end(p_WA, e_1, -axis, shape.radius, 0.0),
                end(p_WB, e_1, axis, shape.radius, 0.0),
            ]
        case shapes.HalfSpace():
            normal = np.asarray(shape.normal)
            require(np.allclose(normal[:2], 0), "HalfSpace.normal", "vertical to be drawn", normal)
            up = float(np.sign(normal[2]))
            low, high = np.asarray(lower)[:2] - GROUND_REACH, np.asarray(upper)[:2] + GROUND_REACH
            corner = np.array([*low, up * shape.offset])
            return [_flat(corner, x, y, up * z, *(high - low))]


def _flat(corner: Array, e_u: Array, e_v: Array, n: Array, width: float, height: float) -> Face:
    def at(uv):
        p = corner + uv[:, :1] * e_u + uv[:, 1:] * e_v
        return p, np.tile(n, (len(uv), 1)), np.tile(e_u, (len(uv), 1))

    return Face((width, height), at)


def _box_faces(box: shapes.Box) -> list[Face]:
    R, p = box.X_WO.rotation().matrix(), box.X_WO.translation()
    half = np.asarray(box.size, float) / 2
    faces = []
    for k in range(3):
        for sign in (-1.0, 1.0):
            # Seen from outside u points right and, on upright faces, v upwards.
            u, v = ((1, 2), (0, 2), (0, 1))[k]
            flip = -sign if k == 1 else sign
            e_u, e_v, n = flip * R[:, u], R[:, v], sign * R[:, k]
            corner = p + half[k] * n - half[u] * e_u - half[v] * e_v
            faces.append(_flat(corner, e_u, e_v, n, 2 * half[u], 2 * half[v]))
    return faces


def _axes(shape: shapes.Capsule | shapes.Cylinder) -> tuple[Array, Array, Array, float]:
    """Returns two unit vectors across the axis, the unit axis and the length [m]."""
    p_AB = np.asarray(shape.p_WB, float) - np.asarray(shape.p_WA, float)
    length = float(np.linalg.norm(p_AB))
    e_1 = perpendicular(p_AB / length)
    return e_1, np.cross(p_AB / length, e_1), p_AB / length, length


def _ring(uv: Array, radius: float, e_1: Array, axis: Array) -> tuple[Array, Array]:
    """Returns unit vectors (N, 3) from an axis to the points of a face, and around the axis."""
    angle, e_2 = uv[:, :1] / radius, np.cross(axis, e_1)
    return np.cos(angle) * e_1 + np.sin(angle) * e_2, -np.sin(angle) * e_1 + np.cos(angle) * e_2


def _side(p_WA: Array, e_1: Array, axis: Array, radius: float, length: float) -> Face:
    def at(uv):
        n, around = _ring(uv, radius, e_1, axis)
        return p_WA + uv[:, 1:] * axis + radius * n, n, around

    return Face((2 * np.pi * radius, length), at, curved=(radius, np.inf))


def _dome(center: Array, e_1: Array, axis: Array, radius: float, low: float) -> Face:
    """The part of a sphere above `low` radii along the axis: -1 for all, 0 for half."""
    first = float(np.arcsin(low))

    def at(uv):
        latitude = np.clip(first + uv[:, 1:] / radius, first, np.pi / 2)
        out, around = _ring(uv, radius, e_1, axis)
        n = np.cos(latitude) * out + np.sin(latitude) * axis
        return center + radius * n, n, around

    size = (2 * np.pi * radius, (np.pi / 2 - first) * radius)
    return Face(size, at, curved=(radius, radius), round=True)


def _disc(center: Array, e_1: Array, axis: Array, radius: float, _: float) -> Face:
    """A flat end: u around, v outwards from the middle."""

    def at(uv):
        out, around = _ring(uv, radius, e_1, axis)
        p = center + np.clip(uv[:, 1:], 0, radius) * out
        return p, np.tile(axis, (len(uv), 1)), around

    return Face((2 * np.pi * radius, radius), at, curved=(radius, np.inf), round=True)


@dataclass(frozen=True, eq=False)
class WorldSpec:
    """A procedural world, in W, from which Gaussians, distances and meshes are made."""

    name: str
    lower_W: Array  # (3,) [m], flyable volume
    upper_W: Array  # (3,) [m]
    solids: list[Solid]  # for cameras and collisions
    p_WS: Array  # (3,) [m], start
    p_WG: Array  # (3,) [m], goal
    light: Callable[[Esdf], Illumination]  # given a grid of the distances
    seed: int = 0
    voxel_size: float = 0.15  # [m], of the distance grid
    # Solids so far outside the volume that its ground or walls are always nearer.
    scenery: list[Solid] = field(default_factory=list)
    # Draws all else out of reach: leaves overhead, bushes and trees around the volume.
    surroundings: Callable[[], list[GaussianScene]] = list
    # Draws all that cameras see; by default the solids in their materials, and the surroundings.
    gaussians: Callable[[Illumination], GaussianScene] | None = None

    @property
    def distance_field(self) -> shapes.AnalyticDistanceField:
        """The exact distances of the solids in the volume."""
        return shapes.AnalyticDistanceField(
            [solid.shape for solid in self.solids], self.lower_W, self.upper_W
        )

    @property
    def plan(self) -> FloorPlan:
        return FloorPlan(self.lower_W, self.upper_W)
