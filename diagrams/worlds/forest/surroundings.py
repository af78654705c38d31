"""What closes the view around a forest: bushes, then the far edge of the trees in the haze."""

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from splatpilot.diagrams.worlds.forest.layout import MARGIN
from splatpilot.diagrams.worlds.plot import Plot
from splatpilot.diagrams.worlds.solids import textures
from splatpilot.diagrams.worlds.solids.light import Daylight, shade
from splatpilot.diagrams.worlds.solids.surfaces import Surfels, to_gaussians
from splatpilot.diagrams.worlds.solids.textures import OAK, mix, smoothstep
from splatpilot.systems.splats.gaussian_scene import GaussianScene

BUSHES, LEAVES = 170, 26
"""Bushes drawn, some of which fall into the volume and are left out, and leaves on each."""


def bushes(plot: Plot, light: Daylight, rng: np.random.Generator) -> GaussianScene:
    """Grows leafy half-spheres in the belt of trees, out of reach of the volume."""
    reach = MARGIN - 3
    foot = rng.uniform(plot.lower[:2] - reach, plot.upper[:2] + reach, (BUSHES, 2))
    foot = foot[plot.outside(foot) > 2.0]
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
    sunlit = light.through_canopy(p, plot.upper[2] + 3, seed=5)
    return paint_leaves(Surfels(p, n, t, extent), albedo, light, sunlit, plot.outside(p), 0.9)


def edge(
    plot: Plot, light: Daylight, away: float, top: float, rng: np.random.Generator
) -> GaussianScene:
    """Hangs a curtain of large patches `away` from the volume, ragged on top; both in metres."""
    spacing = 1.1
    centre, half = (plot.lower + plot.upper)[:2] / 2, (plot.upper - plot.lower)[:2] / 2
    angle = np.arange(0, 2 * np.pi, spacing / (half.max() + away))
    around = np.column_stack([np.cos(angle), np.sin(angle)])
    on_box = np.clip(around / np.abs(around).max(axis=1, keepdims=True), -1, 1) * half
    rim = centre + on_box + around * away
    z = np.arange(0.3, top, spacing)
    p = np.column_stack([np.tile(rim, (len(z), 1)), np.repeat(z, len(rim))])
    p += rng.uniform(-0.5, 0.5, p.shape)
    p = p[p[:, 2] < top * (0.75 + 0.35 * textures.fbm(p * 0.2, 2, seed=91))]
    n = _unit(np.column_stack([centre - p[:, :2], np.zeros(len(p))]))
    stems = smoothstep(0.2, 0.6, textures.value_noise(p[:, :2] * 1.3, seed=92))
    albedo = 0.8 * mix(textures.leaf(OAK, p * 0.4), (0.22, 0.20, 0.17), stems)
    extent = rng.uniform(0.8, 1.2, (len(p), 1)) * (0.85, 0.62)
    up = np.tile((0.0, 0.0, 1.0), (len(p), 1))
    sunlit, distance = (np.full(len(p), value) for value in (0.25, away))
    return paint_leaves(Surfels(p, n, up, extent), albedo, light, sunlit, distance, 0.95)


def trees_around(plot: Plot, hour: Daylight, seed: int) -> Callable[[], list[GaussianScene]]:
    """Draws bushes and two rows of trees far around the volume."""

    def draw() -> list[GaussianScene]:
        rngs = [np.random.default_rng([seed, 50 + k]) for k in range(3)]
        return [
            bushes(plot, hour, rngs[0]),
            edge(plot, hour, 15.0, 9.0, rngs[1]),
            edge(plot, hour, 22.0, 14.0, rngs[2]),
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
    """Patches that let light through as Gaussians.

    Args:
        albedo: (N, 3), sRGB.
        sunlit: (N,) in [0, 1], the part of the sun that reaches them.
        distance: (N,) [m], the way through the haze.
        opacity: a number or (N,).
    """
    irradiance = light.irradiance(surfels.n, sunlit, leafy=True)
    return to_gaussians(surfels, shade(albedo, irradiance, light.haze, distance), opacity)


def _unit(v: NDArray) -> NDArray[np.float64]:
    """The vectors v (..., 3) scaled to length one."""
    return v / np.linalg.norm(v, axis=-1, keepdims=True)
