"""What cameras see of a forest floor and of what lies on it."""

import numpy as np
from numpy.typing import NDArray

from splatpilot.diagrams.worlds.forest.layout import ForestLayout
from splatpilot.diagrams.worlds.forest.light import ForestLight
from splatpilot.diagrams.worlds.solids import textures
from splatpilot.diagrams.worlds.solids.surfaces import (
    COVERAGE,
    Surfels,
    ground_rings,
    inset,
    merge,
    on_ground,
    sphere,
    tube,
)
from splatpilot.diagrams.worlds.solids.textures import OAK, mix, ramp, smoothstep
from splatpilot.systems.splats.gaussian_scene import GaussianScene

SUNK = 0.006
"""[m], depth of the closed layer under the ground: what lies on it is seen in front of it."""


def floor(layout: ForestLayout, light: ForestLight, rng: np.random.Generator) -> GaussianScene:
    """Covers the ground: soil, moss and needles, fine inside the volume, coarser further out."""
    spacings = 0.18, 0.36, 0.7, 1.2, 2.2
    parts = []
    for spacing, p in zip(spacings, ground_rings(layout, spacings, rng), strict=True):
        extent = COVERAGE * spacing * rng.uniform(0.8, 1.25, (len(p), 2))
        angle = rng.uniform(0, np.pi, len(p))
        parts.append(on_ground(p, angle, extent, -SUNK))
    surfels = Surfels.concatenate(parts)
    albedo, _ = textures.forest_floor(surfels.p[:, :2])
    albedo = albedo * rng.uniform(0.8, 1.2, (len(albedo), 1))
    return _on_floor(layout, light, surfels, albedo, 0.99)


def litter(layout: ForestLayout, light: ForestLight, rng: np.random.Generator) -> GaussianScene:
    """Strews leaves, twigs, blades of moss and flat ferns over the ground of the volume."""
    lower, upper = layout.lower[:2] - 0.5, layout.upper[:2] + 0.5
    area = np.prod(upper - lower)

    def strew(density):
        return rng.uniform(lower, upper, (round(density * area), 2))

    p = strew(36)
    _, mossy = textures.forest_floor(p)
    p = p[rng.uniform(size=len(p)) > 0.8 * mossy]
    extent = rng.uniform(0.6, 1.3, (len(p), 1)) * (0.045, 0.026)
    leaves = on_ground(p, rng.uniform(0, np.pi, len(p)), extent, rng.uniform(0.025, 0.04, len(p)))
    scenes = [_on_floor(layout, light, leaves, textures.fallen_leaf(p), 0.93)]

    p = strew(1.6)
    extent = np.column_stack([rng.uniform(0.05, 0.16, len(p)), np.full(len(p), 0.007)])
    twigs = on_ground(p, rng.uniform(0, np.pi, len(p)), extent, 0.035)
    albedo = ramp([(0.20, 0.15, 0.11), (0.50, 0.43, 0.35)], rng.uniform(size=len(p)))
    scenes.append(_on_floor(layout, light, twigs, albedo, 0.9))

    p = strew(20)
    _, mossy = textures.forest_floor(p)
    p = p[rng.uniform(size=len(p)) < mossy]
    extent = rng.uniform(0.7, 1.3, (len(p), 1)) * (0.055, 0.017)
    blades = on_ground(p, rng.uniform(0, np.pi, len(p)), extent, 0.035)
    albedo = textures.moss(blades.p * 3) * rng.uniform(0.6, 1.9, (len(p), 1))
    scenes.append(_on_floor(layout, light, blades, albedo, 0.85))
    scenes.append(_ferns(layout, light, strew(0.10), rng))
    return merge(scenes)


def _ferns(layout, light, p, rng) -> GaussianScene:
    """Spreads a rosette of fronds, each a row of pointed leaflets, flat about each p (N, 2)."""
    fronds, leaflets = 8, 6
    N = len(p)
    angle = (np.arange(fronds) + rng.uniform(-0.3, 0.3, (N, fronds))) * (2 * np.pi / fronds)
    length = rng.uniform(0.28, 0.5, (N, 1)) * rng.uniform(0.8, 1.2, (N, fronds))
    s = (np.arange(leaflets) + 0.7) / leaflets
    bend = angle[..., None] + 0.25 * s * rng.choice([-1, 1], (N, fronds, 1))
    way = np.stack([np.cos(bend), np.sin(bend)], axis=-1)
    q = p[:, None, None] + way * (length[..., None] * s)[..., None]
    along = np.broadcast_to(length[..., None] * 0.10, bend.shape)
    across = length[..., None] * 0.11 * (1.15 - s) * np.ones_like(bend)
    height = 0.02 + 0.025 * np.sin(np.pi * s) * np.ones_like(bend)
    surfels = on_ground(
        q.reshape(-1, 2),
        bend.ravel(),
        np.stack([along, across], axis=-1).reshape(-1, 2),
        height.ravel(),
    )
    albedo = ramp(
        [(0.20, 0.32, 0.10), (0.38, 0.50, 0.16), (0.52, 0.60, 0.22)],
        0.5 + 0.35 * np.broadcast_to(s, bend.shape).ravel() - rng.uniform(0, 0.4, bend.size),
    )
    return _on_floor(layout, light, surfels, albedo, 0.92)


def rocks_and_logs(
    layout: ForestLayout, light: ForestLight, rng: np.random.Generator
) -> list[GaussianScene]:
    """Covers boulders and fallen trunks, mossy on top; the list is empty if there are none."""
    scenes = []
    if len(layout.rocks):
        surfels = Surfels.concatenate([_ball(rock[:3], rock[3]) for rock in layout.rocks])
        scenes.append(_grow_moss(light, surfels, textures.stone(surfels.p)))
    if len(layout.logs):
        parts = []
        for log in layout.logs:
            side = tube(log[:3], log[3:6], log[6], (0.05, 0.11), rng)
            parts.append(inset(side, side.extent[:, 1], log[6]))
            for p_E, inwards in ((log[:3], log[3:6] - log[:3]), (log[3:6], log[:3] - log[3:6])):
                cap = _ball(p_E, log[6])
                parts.append(cap[cap.n @ inwards < 0])
        surfels = Surfels.concatenate(parts)
        rotten = textures.bark(OAK, surfels.p) * (0.82, 0.68, 0.54)
        scenes.append(_grow_moss(light, surfels, rotten))
    return scenes


def _ball(p_C: NDArray, radius: float) -> Surfels:
    patches = sphere(p_C, radius, 0.05)
    return inset(patches, patches.extent[:, 0], radius)


def _grow_moss(light, surfels, albedo) -> GaussianScene:
    seen = surfels.p[:, 2] > -0.05
    surfels, albedo = surfels[seen], albedo[seen]
    cover = surfels.n[:, 2] - 0.35 + 0.9 * textures.fbm(surfels.p * 2.5, 3, seed=81)
    moss = textures.moss(surfels.p * 3)
    albedo = mix(albedo, moss, 0.9 * smoothstep(0.2, 0.5, cover))
    albedo = albedo * (1 + 0.25 * textures.value_noise(surfels.p * 16, seed=82)[:, None])
    return light.paint(surfels, albedo, 0.99)


def _on_floor(layout, light, surfels, albedo, opacity) -> GaussianScene:
    """Colours patches of the ground: none under trunks, rocks and logs, dark against their feet."""
    room = layout.room(surfels.p)
    open_ = room > -0.05
    shade = 0.55 + 0.45 * smoothstep(-0.05, 0.45, room)
    albedo = albedo * shade[:, None]
    return light.paint(surfels[open_], albedo[open_], opacity)
