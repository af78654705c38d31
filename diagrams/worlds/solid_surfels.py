"""Solids as Gaussians: flat patches on their faces, in the colours of their materials."""

import numpy as np
from numpy.typing import NDArray

from flysplat.diagrams.worlds.blueprint import Blueprint
from flysplat.diagrams.worlds.illumination import Illumination, shade
from flysplat.diagrams.worlds.materials import MATERIALS, Marks
from flysplat.diagrams.worlds.solid import Face, Solid, faces_of
from flysplat.diagrams.worlds.surfaces import COVERAGE, Surfels, colored, rectangle
from flysplat.systems.collision.analytic_distance_field import AnalyticDistanceField
from flysplat.systems.collision.shapes import HalfSpace
from flysplat.systems.splats.gaussian_scene import GaussianScene

Array = NDArray[np.float64]

RAISED = 0.004
"""[m], height of marks over the closed layer."""

SOIL = 0.04
"""[m], depth of the patches of the ground under it. Seen at a slant, the near half of each is drawn
first, which brings the ground nearer than it is."""

_BURIED = 0.05
"""[m], depth inside another solid at which a patch cannot be seen any more."""


def draw(blueprint: Blueprint, solids: list[Solid], light: Illumination) -> GaussianScene:
    """Covers `solids`, all or some of the blueprint's, with Gaussians."""
    rng = np.random.default_rng([blueprint.seed, 99])
    scenes = []
    for solid in solids:
        patches, albedo, opacity = _patches(solid, blueprint, rng)
        scenes.append((patches, albedo, opacity, solid))
    surfels = Surfels.joined([patches for patches, *_ in scenes])
    albedo = np.concatenate([albedo for _, albedo, *_ in scenes])
    opacity = np.concatenate([opacity for _, _, opacity, _ in scenes])
    seen = _seen(blueprint, surfels)
    surfels, albedo, opacity = surfels[seen], albedo[seen], opacity[seen]
    irradiance = light.irradiance(surfels.p, surfels.n)
    colors = shade(albedo, irradiance, light.haze, blueprint.plot.outside(surfels.p))
    return colored(surfels, colors, opacity)


def _patches(
    solid: Solid, blueprint: Blueprint, rng: np.random.Generator
) -> tuple[Surfels, Array, Array]:
    """Surfels of one solid with their albedo (N, 3) and opacity (N,)."""
    material = MATERIALS[solid.material]
    parts, albedo, opacity = [], [], []
    for face in faces_of(solid.shape, blueprint.lower_W, blueprint.upper_W):
        if isinstance(solid.shape, HalfSpace):
            uv, extent = _ground(face, material.spacing, blueprint, rng)
        elif face.round:
            uv, extent = _spiral(face, material.spacing, rng)
        else:
            uv, extent = _closed(face, material.spacing, rng)
        p, n, t = face.at(uv)
        if isinstance(solid.shape, HalfSpace):
            p = p - SOIL * n
        parts.append(Surfels(p, n, t, extent))
        albedo.append(_mean_albedo(solid, face, uv, extent) * rng.uniform(0.95, 1.05, (len(p), 1)))
        opacity.append(np.full(len(p), 0.99))
        if face.round or isinstance(solid.shape, HalfSpace):
            continue
        for marks in material.marks:
            uv, extent = _marked(face, marks, rng)
            p, n, t = face.at(uv)
            parts.append(Surfels(p + RAISED * n, n, t, extent))
            albedo.append(solid.albedo(uv, p))
            opacity.append(np.full(len(p), 0.93))
    return Surfels.joined(parts), np.concatenate(albedo), np.concatenate(opacity)


def _mean_albedo(solid: Solid, face: Face, uv: Array, extent: Array) -> Array:
    """Colours (N, 3) of patches about uv (N, 2): means of the pattern at four places, so that thin
    lines tint all the patches they cross instead of dotting some."""
    total = np.zeros((len(uv), 3))
    for corner in ((0.4, 0.8), (0.8, -0.4), (-0.4, -0.8), (-0.8, 0.4)):
        near = uv + corner * extent
        total += 0.25 * solid.albedo(near, face.at(near)[0])
    return total


def _closed(face: Face, spacing: float, rng: np.random.Generator) -> tuple[Array, Array]:
    """Coordinates uv (N, 2) [m] of a jittered lattice that divides the face evenly, and standard
    deviations (N, 2) [m] with which it leaves no holes."""
    size = np.array(face.size)
    n = np.maximum(np.ceil(size / spacing - 1e-6).astype(int), 1)
    if np.isfinite(face.curved[0]):
        n[0] = max(n[0], 6)
    step = size / n
    i, j = np.meshgrid(np.arange(n[0]), np.arange(n[1]), indexing="ij")
    uv = np.stack([i + 0.5, j + 0.5], axis=-1).reshape(-1, 2)
    uv = (uv + rng.uniform(-0.2, 0.2, uv.shape)) * step
    return uv, np.tile(COVERAGE * step, (len(uv), 1))


def _marked(face: Face, marks: Marks, rng: np.random.Generator) -> tuple[Array, Array]:
    """Coordinates uv (N, 2) [m] of the marks that lie on the face, and their standard deviations
    (N, 2) [m]; they stand where the pattern has them."""
    cell = np.array(marks.cell)
    n = np.ceil(np.array(face.size) / cell).astype(int)
    i, j = np.meshgrid(np.arange(n[0]), np.arange(n[1]), indexing="ij")
    places = np.stack([i, j], axis=-1).reshape(-1, 2) + marks.first
    extent = np.tile(cell * marks.fill, (len(places), 1))
    if marks.jitter:
        places = places + rng.uniform(-marks.jitter, marks.jitter, places.shape)
        extent = extent * rng.uniform(0.6, 1.25, extent.shape)
    uv = places * cell
    on_it = ((uv > 0.5 * extent) & (uv < np.array(face.size) - 0.5 * extent)).all(axis=1)
    return uv[on_it], extent[on_it]


def _spiral(face: Face, spacing: float, rng: np.random.Generator) -> tuple[Array, Array]:
    """Coordinates (N, 2) and standard deviations (N, 2) that cover a round face evenly, along a
    spiral of golden angles: equal steps in area from the rim to the pole."""
    radius, (around, height) = face.curved[0], face.size
    flat = not np.isfinite(face.curved[1])
    whole = height > 0.6 * around  # a full sphere, not half
    area = np.pi * radius**2 * (1 if flat else 4 if whole else 2)
    N = max(6, round(area / spacing**2))
    part = (np.arange(N) + 0.5) / N
    angle = np.arange(N) * np.pi * (3 - np.sqrt(5)) + rng.uniform(0, 2 * np.pi)
    if flat:
        v = radius * np.sqrt(part)
    else:
        first = -1.0 if whole else 0.0
        latitude = np.arcsin(first + (1 - first) * part)
        v = radius * (latitude - np.arcsin(first))
    step = np.sqrt(area / N)
    return np.column_stack([radius * angle, v]), np.full((N, 2), COVERAGE * step)


def _ground(
    face: Face, spacing: float, blueprint: Blueprint, rng: np.random.Generator
) -> tuple[Array, Array]:
    """Covers a horizontal plane: finely in the volume, coarsely far out."""
    lower, upper = blueprint.lower_W[:2], blueprint.upper_W[:2]
    corner = lower - 28.0
    uv, extent = [], []
    inner = 0.0
    for outer, coarse in ((0.5, 1.0), (4.0, 2.0), (9.0, 4.0), (16.0, 7.0), (28.0, 12.0)):
        p = rectangle(lower - outer, upper + outer, coarse * spacing, rng)
        p = p[blueprint.plot.outside(p) >= inner] if inner else p
        uv.append(p - corner)
        extent.append(COVERAGE * coarse * spacing * rng.uniform(0.85, 1.2, (len(p), 2)))
        inner = outer
    return np.concatenate(uv), np.concatenate(extent)


def _seen(blueprint: Blueprint, surfels: Surfels) -> NDArray[np.bool_]:
    """Whether a patch faces the volume and lies in no other solid."""
    corner = np.where(surfels.n > 0, blueprint.upper_W, blueprint.lower_W)
    faces = np.einsum("nk,nk->n", surfels.n, corner - surfels.p) > 0
    field = AnalyticDistanceField(
        [solid.shape for solid in blueprint.solids],
        blueprint.lower_W - 40.0,
        blueprint.upper_W + 40.0,
    )
    rows = np.flatnonzero(faces)
    faces[rows] = field.distance(surfels.p[rows]) > -_BURIED
    return faces
