"""What cameras see of trees: bark on the trunks, crowns above the ceiling of the volume."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from splatpilot.diagrams.worlds.forest.layout import ForestLayout
from splatpilot.diagrams.worlds.forest.light import ForestLight
from splatpilot.diagrams.worlds.forest.surroundings import paint_leaves
from splatpilot.diagrams.worlds.solids import textures
from splatpilot.diagrams.worlds.solids.light import Daylight
from splatpilot.diagrams.worlds.solids.surfaces import (
    Surfels,
    inset,
    merge,
    perpendicular,
    tube,
    widest,
)
from splatpilot.diagrams.worlds.solids.textures import BIRCH, OAK, PINE, mix, smoothstep
from splatpilot.systems.splats.gaussian_scene import GaussianScene

_INSET = 0.012
"""[m], how deep the closed layer may lie inside a trunk, where patches are finest: fissures."""


@dataclass(frozen=True)
class _Marks:
    """What stands out of the bark: plates and ridges, or the dark lines on birches."""

    around: float  # [m], spacing around the trunk
    along: float  # [m], spacing along the trunk
    fill: tuple[float, float]  # size along and around, over that of a closed layer
    turn: float  # [rad], standard deviation of the direction about the axis
    kept: float  # part of the marks that is there


_MARKS = {
    OAK: _Marks(around=0.06, along=0.21, fill=(0.72, 0.60), turn=0.13, kept=0.88),
    PINE: _Marks(around=0.08, along=0.16, fill=(0.72, 0.60), turn=0.13, kept=0.88),
    BIRCH: _Marks(around=0.18, along=0.14, fill=(0.07, 0.42), turn=0.06, kept=0.45),
}


def trunks(layout: ForestLayout, light: ForestLight, rng: np.random.Generator) -> GaussianScene:
    """Covers all trunks: a closed layer in the colour of fissures, marks of bark on top of it."""
    trees, ceiling = layout.trees, layout.upper[2]
    away = layout.outside(trees.base)
    foot, middle, top = trees.at(-0.1), trees.at(0.6 * ceiling), trees.at(ceiling)
    tip = trees.base + 0.9 * trees.height[:, None] * trees.lean
    tip = np.column_stack([tip, 0.9 * trees.height])
    scenes = []
    for species, marks in _MARKS.items():
        layers = {"fissures": [], "marks": []}
        for i in np.flatnonzero(trees.species == species):
            radius = trees.radius[i]
            # Finest where the camera flies; crowns hide what is above the ceiling.
            for p_A, p_B, coarse in ((foot[i], middle[i], 1.0), (middle[i], top[i], 1.45)):
                coarse *= 1 + 0.4 * away[i]
                spacing = min(0.12 * coarse, widest(radius, _INSET * coarse)), 0.32 * coarse
                layers["fissures"].append((tube(p_A, p_B, radius, spacing, rng), i))
                if away[i] < 4:
                    spacing = marks.around * coarse, marks.along * coarse
                    layers["marks"].append((tube(p_A, p_B, radius, spacing, rng), i))
            coarse = 2.5 * (1 + 0.4 * away[i])
            spacing = min(0.12 * coarse, widest(radius, _INSET * coarse)), 0.26 * coarse
            crowned = tube(top[i], tip[i], radius, spacing, rng, taper=0.2)
            layers["fissures"].append((crowned, i))
        for layer, tubes in layers.items():
            if not tubes:
                continue
            surfels = Surfels.concatenate([patches for patches, _ in tubes])
            tree = np.repeat([i for _, i in tubes], [len(patches) for patches, _ in tubes])
            keep = layout.is_faced(surfels.p, surfels.n)
            opacity = np.full(len(surfels), 0.99)
            if layer == "marks":
                keep &= rng.uniform(size=len(keep)) < marks.kept
                surfels = _roughen(surfels, marks, rng)
                opacity = rng.uniform(0.75, 0.97, len(surfels))
            surfels, tree = surfels[keep], tree[keep]
            surfels = inset(surfels, surfels.extent[:, 1], trees.radius[tree])
            albedo = _bark(layout, light, species, layer, surfels, tree)
            scenes.append(light.paint(surfels, albedo, opacity[keep]))
    return merge(scenes)


def _roughen(surfels: Surfels, marks: _Marks, rng: np.random.Generator) -> Surfels:
    """Patches of a closed layer as single marks of various sizes and directions."""
    N = len(surfels)
    extent = surfels.extent * marks.fill * rng.uniform(0.6, 1.25, (N, 2))
    turn = rng.normal(0, marks.turn, N)[:, None]
    t = np.cos(turn) * surfels.t + np.sin(turn) * np.cross(surfels.n, surfels.t)
    return Surfels(surfels.p, surfels.n, t, extent)


def _bark(layout, light, species, layer, surfels, tree) -> NDArray:
    """Albedo (N, 3) of patches of one species; `tree` (N,) says whose they are."""
    trees = layout.trees
    z = surfels.p[:, 2]
    p_T = surfels.p.copy()  # along the trunk's own axis, every trunk elsewhere in the texture
    p_T[:, :2] -= trees.base[tree] + z[:, None] * trees.lean[tree]
    p_T[:, :2] += 7.3 * tree[:, None]
    if layer == "fissures":
        albedo = textures.fissure(species, p_T)
    elif species == BIRCH:
        albedo = np.tile((0.20, 0.18, 0.17), (len(z), 1))
    else:
        albedo = textures.bark(species, p_T)
    tone = textures.hash_unit(tree[:, None], seed=71)[:, None]
    warm = textures.hash_unit(tree[:, None], seed=72)[:, None] - 0.5
    albedo = albedo * (0.78 + 0.42 * tone) * (1 + warm * np.array([0.12, 0.0, -0.14]))
    # Moss climbs the shady, damp side of the foot.
    damp = surfels.n[:, :2] @ -light.daylight.direction[:2] + 0.9 * textures.fbm(
        p_T * 2.2, 3, seed=73
    )
    moss = smoothstep(0.35, 0.85, damp + 0.55 - 0.45 * z) * (0.35 if species == BIRCH else 0.9)
    albedo = mix(albedo, textures.moss(p_T * 2.0), moss)

    shade = 0.55 + 0.45 * smoothstep(-0.1, 0.5, z)  # the ground hides the sky from the foot
    return albedo * shade[:, None]


def crowns(layout: ForestLayout, light: Daylight, rng: np.random.Generator) -> GaussianScene:
    """Hangs leaves above the ceiling: cones of whorls on pines, clouds of clumps on the others."""
    trees = layout.trees
    away = layout.outside(trees.base)
    ceiling = layout.upper[2]
    p, n, size, species, depth = [], [], [], [], []
    for i in range(len(trees)):
        kind, coarse = trees.species[i], 1 + 0.12 * away[i]
        low, high = ceiling + rng.uniform(0.5, 1.4), trees.height[i]
        reach = min(0.34 * (high - low) + 0.5, 2.6)
        if kind == PINE:
            N = round(115 / coarse**1.5)
            h = rng.uniform(0, 1, N) ** 1.4
            h = (np.floor(h * 9) + rng.uniform(0, 0.35, N)) / 9  # branches leave in whorls
            out = np.sqrt(rng.uniform(0.05, 1, N))
            angle = rng.uniform(0, 2 * np.pi, N)
            way = np.column_stack([np.cos(angle), np.sin(angle), np.zeros(N)])
            q = way * (reach * (1 - 0.85 * h) * out)[:, None]
            q[:, 2] = low + h * (high - low) - 0.35 * reach * (out**2) * (1 - h) + 0.2
            normal = way * 0.35 + (0, 0, 1) + rng.normal(0, 0.3, (N, 3))
            inner = 1 - out
            extent = np.array([0.27, 0.115])
        else:
            clumps = round(12 / coarse) + 2
            c = rng.normal(size=(clumps, 3))
            c *= (rng.uniform(0.3, 1, (clumps, 1)) ** 0.4) / np.linalg.norm(c, axis=1)[:, None]
            c = c * (1.25 * reach, 1.25 * reach, 0.42 * (high - low)) + (0, 0, (low + high) / 2)
            each = round(11 / coarse) + 2
            d = rng.normal(size=(clumps, each, 3))
            d /= np.linalg.norm(d, axis=-1, keepdims=True)
            q = (c[:, None] + d * rng.uniform(0.35, 0.75, (clumps, each, 1))).reshape(-1, 3)
            normal = d.reshape(-1, 3) + rng.normal(0, 0.5, q.shape)
            inner = 0.5 - 0.5 * d[..., 2].ravel()
            extent = np.array([0.22, 0.15])
        q[:, :2] += trees.base[i] + q[:, 2:] * trees.lean[i]
        spread = rng.uniform(0.7, 1.3, (len(q), 1)) * extent * coarse
        keep = q[:, 2] - 3 * spread.max(axis=1) > ceiling  # out of the volume to the last percent
        for parts, values in zip(
            (p, n, size, species, depth),
            (q, normal, spread, np.full(len(q), kind), inner),
            strict=True,
        ):
            parts.append(values[keep])
    p, n, size, species, depth = (np.concatenate(a) for a in (p, n, size, species, depth))
    n /= np.linalg.norm(n, axis=1, keepdims=True)
    t = perpendicular(n)
    turn = rng.uniform(0, 2 * np.pi, (len(p), 1))
    t = np.cos(turn) * t + np.sin(turn) * np.cross(n, t)
    albedo = np.empty((len(p), 3))
    for kind in (OAK, PINE, BIRCH):
        albedo[species == kind] = textures.leaf(kind, p[species == kind])
    sunlit = smoothstep(ceiling - 1, ceiling + 6, p[:, 2]) * (1 - 0.6 * depth)
    albedo *= (1 - 0.35 * depth)[:, None]
    opacity = rng.uniform(0.7, 0.95, len(p))
    return paint_leaves(Surfels(p, n, t, size), albedo, light, sunlit, layout.outside(p), opacity)
