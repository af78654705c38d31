"""Draws solids as Gaussians: flat patches on their faces, in the colors of their materials."""

import numpy as np
from numpy.typing import NDArray

from splatpilot.diagrams.worlds.solids import surfaces
from splatpilot.diagrams.worlds.solids.solid import (
    MATERIALS,
    Face,
    Marks,
    Solid,
    WorldSpec,
    cut_faces,
)
from splatpilot.diagrams.worlds.solids.textures import Illumination, shade
from splatpilot.diagrams.worlds.world import World
from splatpilot.systems.collision.esdf_build import esdf_from_distance_field
from splatpilot.systems.collision.shapes import AnalyticDistanceField, HalfSpace
from splatpilot.systems.splats.scene import GaussianScene

Array = NDArray[np.float64]

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
    seen = _is_seen(spec, surfels)
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
            uv, extent = _ground(face, material.spacing, spec, rng)
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
        for marks in () if face.round else material.marks:
            low, high = np.zeros(2), np.array(face.size)
            if is_ground:
                low, high = (
                    np.full(2, surfaces.GROUND_REACH - 0.5),
                    high - (surfaces.GROUND_REACH - 0.5),
                )
            uv, extent = _place_marks(marks, low, high, rng)
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
    marks: Marks, low: Array, high: Array, rng: np.random.Generator
) -> tuple[Array, Array]:
    """Returns coordinates uv (N, 2) [m] of the marks of a pattern between the corners `low` and
    `high` (2,) of a face, and their standard deviations (N, 2) [m]."""
    cell = np.array(marks.cell)
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
    """Returns coordinates (N, 2) and standard deviations (N, 2) that cover a round face evenly:
    a spiral of golden angles with equal steps in area from the rim to the pole."""
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


def _ground(
    face: Face, spacing: float, spec: WorldSpec, rng: np.random.Generator
) -> tuple[Array, Array]:
    """Covers a horizontal plane, coarser outside the volume."""
    corner = spec.lower_W[:2] - surfaces.GROUND_REACH
    uv, extent = [], []
    coarser = 1.0, 2.0, 4.0, 7.0, 12.0
    rings = surfaces.ground_rings(spec.plan, [times * spacing for times in coarser], rng)
    for times, p in zip(coarser, rings, strict=True):
        uv.append(p - corner)
        extent.append(surfaces.COVERAGE * times * spacing * rng.uniform(0.85, 1.2, (len(p), 2)))
    return np.concatenate(uv), np.concatenate(extent)


def _is_seen(spec: WorldSpec, surfels: surfaces.Surfels) -> NDArray[np.bool_]:
    """Marks patches that face the volume and are in no other solid."""
    seen = spec.plan.is_faced(surfels.p, surfels.n)
    shapes = [solid.shape for solid in spec.solids]
    field = AnalyticDistanceField(shapes, spec.lower_W - 40.0, spec.upper_W + 40.0)
    rows = np.flatnonzero(seen)
    seen[rows] = field.distance(surfels.p[rows]) > -_BURIED
    return seen


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
