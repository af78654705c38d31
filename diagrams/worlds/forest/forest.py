"""Generated forests: layout, light and Gaussians."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from splatpilot.diagrams.worlds.building_blocks import INSET
from splatpilot.diagrams.worlds.forest.layout import (
    MARGIN,
    ForestConfig,
    ForestLayout,
    TrunksConfig,
    lay_out,
)
from splatpilot.diagrams.worlds.solids import textures
from splatpilot.diagrams.worlds.solids.solid import WorldSpec
from splatpilot.diagrams.worlds.solids.surfaces import (
    COVERAGE,
    FloorPlan,
    Surfels,
    ground_rings,
    inset,
    merge,
    on_ground,
    perpendicular,
    sphere,
    to_gaussians,
    tube,
    widest,
)
from splatpilot.diagrams.worlds.solids.textures import (
    BIRCH,
    OAK,
    PINE,
    Daylight,
    mix,
    ramp,
    shade,
    smoothstep,
)
from splatpilot.systems.splats.scene import GaussianScene


@dataclass(frozen=True, eq=False)
class ForestLight:
    """Daylight with the shadows of trees: an `Illumination`."""

    daylight: Daylight
    layout: ForestLayout
    seed: int  # of the gaps between the leaves

    @property
    def haze(self) -> NDArray[np.float64]:
        return self.daylight.haze

    def irradiance(self, p_W: NDArray, n_W: NDArray) -> NDArray[np.float64]:
        foot = 0.55 + 0.45 * smoothstep(-0.1, 0.5, p_W[:, 2] + np.abs(n_W[:, 2]))
        return self.daylight.irradiance(n_W, self._sunlit(p_W)) * foot[:, None]

    def paint(self, surfels: Surfels, albedo: NDArray, opacity: ArrayLike) -> GaussianScene:
        """Draws patches of `albedo` (N, 3), sRGB, and `opacity`, a number or (N,)."""
        irradiance = self.daylight.irradiance(surfels.n, self._sunlit(surfels.p))
        colors = shade(albedo, irradiance, self.haze, self.layout.outside(surfels.p))
        return to_gaussians(surfels, colors, opacity)

    def _sunlit(self, p: NDArray) -> NDArray:
        """Computes the fraction of the sun (N,) past trunks and leaves at p (N, 3) [m]."""
        near, trees, top = self._shading, self.layout.trees, float(self.layout.upper[2]) + 3
        past = self.daylight.past_trunks(p, trees.at(2.0)[near, :2], trees.radius[near], top)
        return past * self.daylight.through_canopy(p, top, self.seed)

    @cached_property
    def _shading(self) -> NDArray[np.bool_]:
        """Marks the trees near enough to shade the volume."""
        return self.layout.outside(self.layout.trees.base) < self.layout.upper[2]


SUNK = 0.006  # [m], depth of the closed layer under the ground, so that litter is in front of it


def floor(layout: ForestLayout, light: ForestLight, rng: np.random.Generator) -> GaussianScene:
    """Covers the ground with soil, moss and needles, coarser outside the volume."""
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
    """Scatters leaves, twigs, blades of moss and flat ferns over the ground of the volume."""
    lower, upper = layout.lower[:2] - 0.5, layout.upper[:2] + 0.5
    area = np.prod(upper - lower)

    def scatter(density):
        return rng.uniform(lower, upper, (round(density * area), 2))

    p = scatter(36)
    _, mossy = textures.forest_floor(p)
    p = p[rng.uniform(size=len(p)) > 0.8 * mossy]
    extent = rng.uniform(0.6, 1.3, (len(p), 1)) * (0.045, 0.026)
    leaves = on_ground(p, rng.uniform(0, np.pi, len(p)), extent, rng.uniform(0.025, 0.04, len(p)))
    scenes = [_on_floor(layout, light, leaves, textures.fallen_leaf(p), 0.93)]

    p = scatter(1.6)
    extent = np.column_stack([rng.uniform(0.05, 0.16, len(p)), np.full(len(p), 0.007)])
    twigs = on_ground(p, rng.uniform(0, np.pi, len(p)), extent, 0.035)
    albedo = ramp([(0.20, 0.15, 0.11), (0.50, 0.43, 0.35)], rng.uniform(size=len(p)))
    scenes.append(_on_floor(layout, light, twigs, albedo, 0.9))

    p = scatter(20)
    _, mossy = textures.forest_floor(p)
    p = p[rng.uniform(size=len(p)) < mossy]
    extent = rng.uniform(0.7, 1.3, (len(p), 1)) * (0.055, 0.017)
    blades = on_ground(p, rng.uniform(0, np.pi, len(p)), extent, 0.035)
    albedo = textures.moss(blades.p * 3) * rng.uniform(0.6, 1.9, (len(p), 1))
    scenes.append(_on_floor(layout, light, blades, albedo, 0.85))
    scenes.append(_ferns(layout, light, scatter(0.10), rng))
    return merge(scenes)


def _ferns(layout, light, p, rng) -> GaussianScene:
    """Draws a rosette of fronds, each a row of pointed leaflets, flat about each p (N, 2)."""
    fronds, leaflets = 8, 6
    N = len(p)
    angle = (np.arange(fronds) + rng.uniform(-0.3, 0.3, (N, fronds))) * (2 * np.pi / fronds)
    length = rng.uniform(0.28, 0.5, (N, 1)) * rng.uniform(0.8, 1.2, (N, fronds))
    s = (np.arange(leaflets) + 0.7) / leaflets
    bend = angle[..., None] + 0.25 * s * rng.choice([-1, 1], (N, fronds, 1))
    direction = np.stack([np.cos(bend), np.sin(bend)], axis=-1)
    q = p[:, None, None] + direction * (length[..., None] * s)[..., None]
    along = np.broadcast_to(length[..., None] * 0.10, bend.shape)
    across = length[..., None] * 0.11 * (1.15 - s) * np.ones_like(bend)
    height = 0.02 + 0.025 * np.sin(np.pi * s) * np.ones_like(bend)
    extent = np.stack([along, across], axis=-1).reshape(-1, 2)
    surfels = on_ground(q.reshape(-1, 2), bend.ravel(), extent, height.ravel())
    tone = 0.5 + 0.35 * np.broadcast_to(s, bend.shape).ravel() - rng.uniform(0, 0.4, bend.size)
    albedo = ramp([(0.20, 0.32, 0.10), (0.38, 0.50, 0.16), (0.52, 0.60, 0.22)], tone)
    return _on_floor(layout, light, surfels, albedo, 0.92)


def rocks_and_logs(
    layout: ForestLayout, light: ForestLight, rng: np.random.Generator
) -> list[GaussianScene]:
    """Covers boulders and fallen trunks, mossy on top."""
    scenes = []
    if len(layout.rocks):
        surfels = Surfels.concatenate([_sphere(rock[:3], rock[3]) for rock in layout.rocks])
        scenes.append(_grow_moss(light, surfels, textures.stone(surfels.p)))
    if len(layout.logs):
        parts = []
        for log in layout.logs:
            side = tube(log[:3], log[3:6], log[6], (0.05, 0.11), rng)
            parts.append(inset(side, side.extent[:, 1], log[6]))
            for p_E, p_F in ((log[:3], log[3:6]), (log[3:6], log[:3])):
                cap = _sphere(p_E, log[6])
                parts.append(cap[cap.n @ (p_F - p_E) < 0])
        surfels = Surfels.concatenate(parts)
        rotten = textures.bark(OAK, surfels.p) * (0.82, 0.68, 0.54)
        scenes.append(_grow_moss(light, surfels, rotten))
    return scenes


def _sphere(p_C: NDArray, radius: float) -> Surfels:
    patches = sphere(p_C, radius, 0.05)
    return inset(patches, patches.extent[:, 0], radius)


def _grow_moss(light, surfels, albedo) -> GaussianScene:
    seen = surfels.p[:, 2] > -0.05  # above ground
    surfels, albedo = surfels[seen], albedo[seen]
    cover = surfels.n[:, 2] - 0.35 + 0.9 * textures.fbm(surfels.p * 2.5, 3, seed=81)
    moss = textures.moss(surfels.p * 3)
    albedo = mix(albedo, moss, 0.9 * smoothstep(0.2, 0.5, cover))
    albedo = albedo * (1 + 0.25 * textures.value_noise(surfels.p * 16, seed=82)[:, None])
    return light.paint(surfels, albedo, 0.99)


def _on_floor(layout, light, surfels, albedo, opacity) -> GaussianScene:
    """Draws patches of the ground: none under trunks, rocks and logs, dark beside them."""
    clearance = layout.clearance(surfels.p)
    open_ = clearance > -0.05
    shade = 0.55 + 0.45 * smoothstep(-0.05, 0.45, clearance)
    albedo = albedo * shade[:, None]
    return light.paint(surfels[open_], albedo[open_], opacity)


# Number of bushes, including those left out in the volume, and of leaves on each
BUSHES, LEAVES = 170, 26


def bushes(plan: FloorPlan, light: Daylight, rng: np.random.Generator) -> GaussianScene:
    """Draws leafy half-spheres in the belt of trees outside the volume."""
    reach = MARGIN - 3
    foot = rng.uniform(plan.lower[:2] - reach, plan.upper[:2] + reach, (BUSHES, 2))
    foot = foot[plan.outside(foot) > 2.0]
    n = rng.normal(size=(len(foot), LEAVES, 3))
    n[..., 2] = np.abs(n[..., 2])
    n = _unit(n)
    size = rng.uniform(0.5, 1.15, (len(foot), 1, 1)) * rng.uniform(0.6, 1.0, (len(foot), LEAVES, 1))
    p = n * size
    p[..., :2] += foot[:, None]
    p = p.reshape(-1, 3)
    n = _unit(n.reshape(-1, 3) + rng.normal(0, 0.4, p.shape))
    t = _unit(np.cross(n, rng.normal(size=n.shape)))
    extent = rng.uniform(0.7, 1.3, (len(p), 1)) * (0.19, 0.11)
    foot = 0.45 + 0.55 * smoothstep(0.0, 0.8, p[:, 2])  # the ground hides the sky from it
    albedo = textures.leaf(OAK, p) * foot[:, None]
    sunlit = light.through_canopy(p, plan.upper[2] + 3, seed=5)
    return paint_leaves(Surfels(p, n, t, extent), albedo, light, sunlit, plan.outside(p), 0.9)


def edge(
    plan: FloorPlan, light: Daylight, away: float, top: float, rng: np.random.Generator
) -> GaussianScene:
    """Draws a curtain of large patches `away` [m] from the volume, about `top` [m] high."""
    spacing = 1.1
    center, half = (plan.lower + plan.upper)[:2] / 2, (plan.upper - plan.lower)[:2] / 2
    angle = np.arange(0, 2 * np.pi, spacing / (half.max() + away))
    around = np.column_stack([np.cos(angle), np.sin(angle)])
    on_box = np.clip(around / np.abs(around).max(axis=1, keepdims=True), -1, 1) * half
    rim = center + on_box + around * away
    z = np.arange(0.3, top, spacing)
    p = np.column_stack([np.tile(rim, (len(z), 1)), np.repeat(z, len(rim))])
    p += rng.uniform(-0.5, 0.5, p.shape)
    p = p[p[:, 2] < top * (0.75 + 0.35 * textures.fbm(p * 0.2, 2, seed=91))]
    n = _unit(np.column_stack([center - p[:, :2], np.zeros(len(p))]))
    stems = smoothstep(0.2, 0.6, textures.value_noise(p[:, :2] * 1.3, seed=92))
    albedo = 0.8 * mix(textures.leaf(OAK, p * 0.4), (0.22, 0.20, 0.17), stems)
    extent = rng.uniform(0.8, 1.2, (len(p), 1)) * (0.85, 0.62)
    up = np.tile((0.0, 0.0, 1.0), (len(p), 1))
    sunlit, distance = (np.full(len(p), value) for value in (0.25, away))
    return paint_leaves(Surfels(p, n, up, extent), albedo, light, sunlit, distance, 0.95)


def trees_around(plan: FloorPlan, hour: Daylight, seed: int) -> Callable[[], list[GaussianScene]]:
    """Returns a function that draws bushes and two rows of trees around the volume."""

    def draw() -> list[GaussianScene]:
        rngs = [np.random.default_rng([seed, 50 + k]) for k in range(3)]
        return [
            bushes(plan, hour, rngs[0]),
            edge(plan, hour, 15.0, 9.0, rngs[1]),
            edge(plan, hour, 22.0, 14.0, rngs[2]),
        ]

    return draw


def paint_leaves(
    surfels: Surfels,
    albedo: NDArray,
    light: Daylight,
    sunlit: ArrayLike,
    distance: ArrayLike,
    opacity: ArrayLike,
) -> GaussianScene:
    """Draws patches that let light through, see `Daylight.irradiance` and `shade`."""
    irradiance = light.irradiance(surfels.n, sunlit, leafy=True)
    return to_gaussians(surfels, shade(albedo, irradiance, light.haze, distance), opacity)


def _unit(v: NDArray) -> NDArray[np.float64]:
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


# [m], maximum depth of the closed layer, the fissures, inside a trunk with the finest patches
_INSET = 0.012


@dataclass(frozen=True)
class _Marks:
    """Marks on bark: plates and ridges, or the dark lines of birches."""

    around: float  # [m], spacing around the trunk
    along: float  # [m], spacing along the trunk
    fill: tuple[float, float]  # size along and around, over that of a closed layer
    turn: float  # [rad], standard deviation of the direction about the axis
    kept: float  # fraction of the marks that is drawn


_MARKS = {
    OAK: _Marks(around=0.06, along=0.21, fill=(0.72, 0.60), turn=0.13, kept=0.88),
    PINE: _Marks(around=0.08, along=0.16, fill=(0.72, 0.60), turn=0.13, kept=0.88),
    BIRCH: _Marks(around=0.18, along=0.14, fill=(0.07, 0.42), turn=0.06, kept=0.45),
}


def trunks(layout: ForestLayout, light: ForestLight, rng: np.random.Generator) -> GaussianScene:
    """Covers all trunks with a closed layer in the color of fissures and marks of bark on it."""
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
            for p_A, p_B, coarse, along, taper in (
                (foot[i], middle[i], 1.0, 0.32, 1.0),
                (middle[i], top[i], 1.45, 0.32, 1.0),
                (top[i], tip[i], 2.5, 0.26, 0.2),
            ):
                coarse *= 1 + 0.4 * away[i]
                spacing = min(0.12 * coarse, widest(radius, _INSET * coarse)), along * coarse
                layers["fissures"].append((tube(p_A, p_B, radius, spacing, rng, taper), i))
                if away[i] < 4 and taper == 1.0:
                    spacing = marks.around * coarse, marks.along * coarse
                    layers["marks"].append((tube(p_A, p_B, radius, spacing, rng), i))
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
    """Turns patches of a closed layer into marks of various sizes and directions."""
    N = len(surfels)
    extent = surfels.extent * marks.fill * rng.uniform(0.6, 1.25, (N, 2))
    t = _rotated(surfels.n, surfels.t, rng.normal(0, marks.turn, N)[:, None])
    return replace(surfels, t=t, extent=extent)


def _rotated(n: NDArray, t: NDArray, angle: NDArray) -> NDArray[np.float64]:
    """Rotates vectors (N, 3) about unit normals (N, 3) by angles (N, 1) [rad]."""
    return np.cos(angle) * t + np.sin(angle) * np.cross(n, t)


def _bark(layout, light, species, layer, surfels, tree) -> NDArray:
    """Computes the albedo (N, 3) of patches on the trunks of the trees with indices `tree` (N,)."""
    trees, z = layout.trees, surfels.p[:, 2]
    p_T = surfels.p.copy()  # along the trunk's own axis, at another part of the texture per trunk
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
    shady = surfels.n[:, :2] @ -light.daylight.direction[:2]
    damp = shady + 0.9 * textures.fbm(p_T * 2.2, 3, seed=73)
    moss = smoothstep(0.35, 0.85, damp + 0.55 - 0.45 * z) * (0.35 if species == BIRCH else 0.9)
    albedo = mix(albedo, textures.moss(p_T * 2.0), moss)

    shade = 0.55 + 0.45 * smoothstep(-0.1, 0.5, z)  # the ground hides the sky from the foot
    return albedo * shade[:, None]


def crowns(layout: ForestLayout, light: Daylight, rng: np.random.Generator) -> GaussianScene:
    """Draws leaves above the ceiling: cones of whorls on pines, clouds of clumps on the others."""
    trees, ceiling = layout.trees, layout.upper[2]
    away = layout.outside(trees.base)
    leaves = []
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
            outwards = np.column_stack([np.cos(angle), np.sin(angle), np.zeros(N)])
            q = outwards * (reach * (1 - 0.85 * h) * out)[:, None]
            q[:, 2] = low + h * (high - low) - 0.35 * reach * (out**2) * (1 - h) + 0.2
            normal = outwards * 0.35 + (0, 0, 1) + rng.normal(0, 0.3, (N, 3))
            inner = 1 - out
            extent = np.array([0.27, 0.115])
        else:
            clumps = round(12 / coarse) + 2
            c = rng.normal(size=(clumps, 3))
            c *= (rng.uniform(0.3, 1, (clumps, 1)) ** 0.4) / np.linalg.norm(c, axis=1)[:, None]
            c = c * (1.25 * reach, 1.25 * reach, 0.42 * (high - low)) + (0, 0, (low + high) / 2)
            each = round(11 / coarse) + 2
            d = _unit(rng.normal(size=(clumps, each, 3)))
            q = (c[:, None] + d * rng.uniform(0.35, 0.75, (clumps, each, 1))).reshape(-1, 3)
            normal = d.reshape(-1, 3) + rng.normal(0, 0.5, q.shape)
            inner = 0.5 - 0.5 * d[..., 2].ravel()
            extent = np.array([0.22, 0.15])
        q[:, :2] += trees.base[i] + q[:, 2:] * trees.lean[i]
        spread = rng.uniform(0.7, 1.3, (len(q), 1)) * extent * coarse
        keep = q[:, 2] - 3 * spread.max(axis=1) > ceiling  # outside the volume
        values = q, normal, spread, np.full(len(q), kind), inner
        leaves.append([value[keep] for value in values])
    p, n, size, species, depth = map(np.concatenate, zip(*leaves, strict=True))
    n = _unit(n)
    t = _rotated(n, perpendicular(n), rng.uniform(0, 2 * np.pi, (len(p), 1)))
    albedo = np.empty((len(p), 3))
    for kind in (OAK, PINE, BIRCH):
        albedo[species == kind] = textures.leaf(kind, p[species == kind])
    sunlit = smoothstep(ceiling - 1, ceiling + 6, p[:, 2]) * (1 - 0.6 * depth)
    albedo *= (1 - 0.35 * depth)[:, None]
    opacity = rng.uniform(0.7, 0.95, len(p))
    return paint_leaves(Surfels(p, n, t, size), albedo, light, sunlit, layout.outside(p), opacity)


def forest_spec(config: ForestConfig, seed: int) -> WorldSpec:
    """Grows the forest of `config`, through which a path exists: trunks grown by the vehicle's
    radius are disjoint and leave space at the sides (`TrunksConfig.check`), rocks and logs end
    below the flight height, and no trunk is near start and goal."""
    return Forest(config, seed).spec()


class Forest:
    """Layout and light of the forest of `config` and `seed`."""

    def __init__(self, config: TrunksConfig, seed: int) -> None:
        self.config, self.seed = config, seed
        # A stream of random numbers per part, so that parts change independently.
        layout_rng, light_rng = (np.random.default_rng([seed, k]) for k in range(2))
        self.p_WS = np.array([INSET, 0.0, config.flight_height])
        self.p_WG = np.array([config.length - INSET, 0.0, config.flight_height])
        self.layout = lay_out(config, layout_rng, [self.p_WS[:2], self.p_WG[:2]])
        self.light = ForestLight(Daylight.sample(light_rng), self.layout, seed)

    def spec(self) -> WorldSpec:
        solids, scenery = self.layout.solids()
        return WorldSpec(
            name="forest",
            lower_W=self.layout.lower,
            upper_W=self.layout.upper,
            solids=solids,
            scenery=scenery,
            p_WS=self.p_WS,
            p_WG=self.p_WG,
            light=lambda _: self.light,
            surroundings=lambda: self._surroundings(self._streams()),
            gaussians=lambda _: self.gaussians(),
            seed=self.seed,
            voxel_size=self.config.voxel_size,
        )

    def gaussians(self) -> GaussianScene:
        """Draws all that cameras see."""
        layout, light, rngs = self.layout, self.light, self._streams()
        leaves, *around = self._surroundings(rngs)
        return merge(
            [
                trunks(layout, light, rngs[0]),
                leaves,
                floor(layout, light, rngs[2]),
                litter(layout, light, rngs[3]),
                *rocks_and_logs(layout, light, rngs[4]),
                *around,
            ]
        )

    def _streams(self) -> list[np.random.Generator]:
        return [np.random.default_rng([self.seed, k]) for k in range(2, 10)]

    def _surroundings(self, rngs: list[np.random.Generator]) -> list[GaussianScene]:
        """Draws crowns, bushes and the distant edge of the trees."""
        layout, daylight = self.layout, self.light.daylight
        return [
            crowns(layout, daylight, rngs[1]),
            bushes(layout, daylight, rngs[5]),
            edge(layout, daylight, MARGIN + 3, 9.0, rngs[6]),
            edge(layout, daylight, MARGIN + 9, 13.0, rngs[7]),
        ]
