"""Solids: shapes of a material, drawn as flat Gaussians on the faces of their surface."""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial

import numpy as np
from numpy.typing import NDArray

from splatpilot.diagrams.worlds.solids import patterns, surfaces
from splatpilot.diagrams.worlds.solids.surfaces import GROUND_REACH, FloorPlan, perpendicular
from splatpilot.diagrams.worlds.solids.textures import BIRCH, OAK, PINE, Illumination, shade
from splatpilot.diagrams.worlds.world import World
from splatpilot.systems.collision import shapes
from splatpilot.systems.collision.esdf import Esdf
from splatpilot.systems.collision.esdf_build import esdf_from_distance_field
from splatpilot.systems.collision.shapes import AnalyticDistanceField, HalfSpace
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
        # In the solid's frame, z along its axis, shifted by its seed.
        p, shift = p_W, 7.3 * np.array([self.seed % 61, self.seed % 53, 0.0])
        match shape := self.shape:
            case shapes.Sphere():
                p = p_W - np.asarray(shape.p_WO) + shift
            case shapes.Box():
                p = shape.X_WO.inverse().multiply(p_W.T).T + shift
            case shapes.Capsule() | shapes.Cylinder():
                e_1, e_2, axis, _ = _axes(shape)
                p = (p_W - np.asarray(shape.p_WA)) @ np.column_stack([e_1, e_2, axis]) + shift
        return MATERIALS[self.material].albedo(uv, p, self.seed)


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


_RAISED = 0.004  # [m], height of marks over the closed layer
_INSET = 0.006  # [m], maximum depth of the closed layer of a curved surface inside it
_BURIED = 0.05  # [m], depth inside another solid at which a patch is hidden
_CORNERS = (0.4, 0.7), (-0.4, -0.7)  # [standard deviations], samples of a patch about its middle


def draw(spec: WorldSpec, solids: list[Solid], light: Illumination) -> GaussianScene:
    """Covers `solids`, all or some of the spec's, with Gaussians."""
    rng = np.random.default_rng([spec.seed, 99])
    drawn = [_patches(solid, spec, rng) for solid in solids]
    patches, albedos, opacities = zip(*drawn, strict=True)
    surfels = surfaces.Surfels.concatenate(list(patches))
    albedo, opacity = np.concatenate(albedos), np.concatenate(opacities)
    # Patches that face the volume and are in no other solid.
    seen = spec.plan.is_faced(surfels.p, surfels.n)
    all_shapes = [solid.shape for solid in spec.solids]
    field = AnalyticDistanceField(all_shapes, spec.lower_W - 40.0, spec.upper_W + 40.0)
    rows = np.flatnonzero(seen)
    seen[rows] = field.distance(surfels.p[rows]) > -_BURIED
    surfels, albedo, opacity = surfels[seen], np.clip(albedo[seen], 0, 1), opacity[seen]
    irradiance = light.irradiance(surfels.p, surfels.n)
    colors = shade(albedo, irradiance, light.haze, spec.plan.outside(surfels.p))
    return surfaces.to_gaussians(surfels, colors, opacity)


def _patches(
    solid: Solid, spec: WorldSpec, rng: np.random.Generator
) -> tuple[surfaces.Surfels, Array, Array]:
    """Returns patches of one solid, their albedo (N, 3) and opacity (N,)."""
    material = MATERIALS[solid.material]
    is_ground = isinstance(solid.shape, HalfSpace)
    layers = []  # of patches, opacity, face and coordinates at which the pattern is sampled
    for face in cut_faces(solid.shape, spec.lower_W, spec.upper_W):
        if is_ground:
            uv, extent = _ground(material.spacing, spec, rng)
        else:
            uv, extent = (_spiral if face.round else _lattice)(face, material.spacing, rng)
        facing = spec.plan.is_faced(*face.at(uv)[:2])
        if not facing.any():
            continue
        uv, extent = uv[facing], extent[facing]
        layer = surfaces.Surfels(*face.at(uv), extent)
        if _bulges(face):
            layer = surfaces.inset(layer, extent[:, 0], face.curved[0])
        # Means of the pattern at two points: thin lines tint all the patches they cross.
        layers.append((layer, 0.99, face, [uv + corner * extent for corner in _CORNERS]))
        margin = surfaces.GROUND_REACH - 0.5 if is_ground else 0.0
        for marks in () if face.round else material.marks:
            uv, extent = _place_marks(marks, face, margin, rng)
            p, n, t = face.at(uv)
            layers.append((surfaces.Surfels(p + _RAISED * n, n, t, extent), 0.93, face, [uv]))
    if not layers:
        zero = np.zeros((0, 3))
        return surfaces.Surfels(zero, zero, zero, zero[:, :2]), zero, zero[:, 0]
    uv = np.concatenate([q for *_, samples in layers for q in samples])
    p = np.concatenate([face.at(q)[0] for *_, face, samples in layers for q in samples])
    colors = solid.albedo(uv, p)  # all at once: calls of patterns are expensive
    albedo, start = [], 0
    for patches, _, _, samples in layers:
        stop = start + len(patches) * len(samples)
        albedo.append(colors[start:stop].reshape(len(samples), len(patches), 3).mean(axis=0))
        start = stop
    tinted = np.concatenate(albedo)
    tinted = tinted * rng.uniform(0.95, 1.05, (len(tinted), 1))
    opacity = np.concatenate([np.full(len(patches), o) for patches, o, *_ in layers])
    return surfaces.Surfels.concatenate([patches for patches, *_ in layers]), tinted, opacity


def _lattice(face: Face, spacing: float, rng: np.random.Generator) -> tuple[Array, Array]:
    """Returns coordinates uv (N, 2) [m] of a jittered lattice on the face, and standard deviations
    (N, 2) [m] with which it has no holes and ends at the edge."""
    size, spacings = np.array(face.size), np.full(2, spacing)
    if _bulges(face):
        spacings[0] = min(spacing, surfaces.widest(face.curved[0], _INSET))
    n = np.maximum(np.ceil(size / spacings - 1e-6).astype(int), 1)
    step = size / n
    i, j = np.meshgrid(np.arange(n[0]), np.arange(n[1]), indexing="ij")
    uv = np.stack([i + 0.5, j + 0.5], axis=-1).reshape(-1, 2)
    uv = (uv + rng.uniform(-0.2, 0.2, uv.shape)) * step
    extent = np.minimum(surfaces.COVERAGE * step, np.minimum(uv, size - uv) / surfaces.RIM)
    if _bulges(face):  # no edge around
        extent[:, 0] = surfaces.COVERAGE * step[0]
    return uv, extent


def _bulges(face: Face) -> bool:
    """Checks that a face is curved, not flat or a disc."""
    return np.isfinite(face.curved[0]) and not (face.round and np.isinf(face.curved[1]))


def _place_marks(
    marks: Marks, face: Face, margin: float, rng: np.random.Generator
) -> tuple[Array, Array]:
    """Returns coordinates uv (N, 2) [m] of the marks of a pattern on a face without a margin [m],
    and their standard deviations (N, 2) [m]."""
    low, high, cell = np.full(2, margin), np.array(face.size) - margin, np.array(marks.cell)
    first, last = np.floor(low / cell).astype(int), np.ceil(high / cell).astype(int)
    i, j = (np.arange(a, b) for a, b in zip(first, last, strict=True))
    cells = np.stack(np.meshgrid(i, j, indexing="ij"), axis=-1).reshape(-1, 2) + marks.first
    extent = np.tile(cell * marks.fill, (len(cells), 1))
    if marks.jitter:
        cells = cells + rng.uniform(-marks.jitter, marks.jitter, cells.shape)
        extent = extent * rng.uniform(0.6, 1.25, extent.shape)
    uv = cells * cell
    to_edge = np.minimum(uv - low, high - uv)
    inside = (to_edge > 0.5 * extent).all(axis=1)
    return uv[inside], np.minimum(extent, to_edge / 2)[inside]


def _spiral(face: Face, spacing: float, rng: np.random.Generator) -> tuple[Array, Array]:
    """Covers a round face by a spiral of golden angles; see `_lattice`."""
    radius, (around, height) = face.curved[0], face.size
    flat = not _bulges(face)
    if not flat:
        spacing = min(spacing, surfaces.widest(radius, _INSET))
    whole = height > 0.4 * around  # a full sphere, not half
    area = np.pi * radius**2 * (1 if flat else 4 if whole else 2)
    N = max(6, round(area / spacing**2))
    part = (np.arange(N) + 0.5) / N
    angle = np.arange(N) * np.pi * (3 - np.sqrt(5)) + rng.uniform(0, 2 * np.pi)
    step = np.sqrt(area / N)
    extent = np.full((N, 2), surfaces.COVERAGE * step)
    if flat:
        v = (radius - 0.4 * step) * np.sqrt(part)
        extent[:, 1] = np.minimum(extent[:, 1], (radius - v) / surfaces.RIM)
    else:
        first = -1.0 if whole else 0.0
        latitude = np.arcsin(first + (1 - first) * part)
        v = radius * (latitude - np.arcsin(first))
    return np.column_stack([radius * angle, v]), extent


def _ground(spacing: float, spec: WorldSpec, rng: np.random.Generator) -> tuple[Array, Array]:
    """Covers a horizontal plane, coarser outside the volume; see `_lattice`."""
    corner = spec.lower_W[:2] - surfaces.GROUND_REACH
    uv, extent = [], []
    coarser = 1.0, 2.0, 4.0, 7.0, 12.0
    rings = surfaces.ground_rings(spec.plan, [times * spacing for times in coarser], rng)
    for times, p in zip(coarser, rings, strict=True):
        uv.append(p - corner)
        extent.append(surfaces.COVERAGE * times * spacing * rng.uniform(0.85, 1.2, (len(p), 2)))
    return np.concatenate(uv), np.concatenate(extent)


def build(spec: WorldSpec) -> World:
    """Draws a spec's Gaussians and samples its distance grid."""
    field = spec.distance_field
    esdf = esdf_from_distance_field(field, spec.voxel_size)
    light = spec.light(esdf)
    if spec.gaussians is not None:
        gaussians = spec.gaussians(light)
    else:
        gaussians = surfaces.merge([draw(spec, spec.solids, light), *spec.surroundings()])
    haze = tuple(light.haze.tolist())
    return World(spec.name, gaussians, field, esdf, haze, spec.p_WS, spec.p_WG)
