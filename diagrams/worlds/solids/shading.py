"""Light on the surfaces of a world: from the sun past obstacles, or from lamps."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from splatpilot.diagrams.worlds.solids.textures import fbm, smoothstep
from splatpilot.systems.collision.esdf import Esdf

GAMMA = 2.2
HAZE_RANGE = 16.0  # [m], distance through the surroundings over which colors fade by a factor e


@dataclass(frozen=True, eq=False)
class Daylight:
    """Irradiance of one hour of the day; a white surface under 1 has full brightness."""

    direction: NDArray[np.float64]  # (3,), unit vector from the ground to the sun, in W
    sun: NDArray[np.float64]  # (3,) linear RGB, like `sky` and `ground`
    sky: NDArray[np.float64]
    ground: NDArray[np.float64]
    haze: NDArray[np.float64]  # (3,) sRGB, see `Illumination`

    @classmethod
    def sample(cls, rng: np.random.Generator) -> "Daylight":
        """Draws the hour: the lower the sun, the warmer its light."""
        azimuth, elevation = rng.uniform(-np.pi, np.pi), np.deg2rad(rng.uniform(32, 58))
        warmth = 0.8 * float(smoothstep(58, 32, np.rad2deg(elevation)))
        x, y = np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth)
        return cls(
            direction=np.array([x, y, np.sin(elevation)]),
            sun=2.6 * np.array([1.0, 0.93 - 0.08 * warmth, 0.80 - 0.22 * warmth]),
            sky=0.74 * np.array([0.93, 1.0, 0.99]),
            ground=0.33 * np.array([1.05, 1.0, 0.72]),
            haze=np.array([0.80, 0.86, 0.86]) + warmth * np.array([0.05, 0.0, -0.06]),
        )

    def irradiance(
        self, normal: ArrayLike, sunlit: ArrayLike, leafy: bool = False
    ) -> NDArray[np.float64]:
        """Computes light, linear (N, 3), on surfaces of unit normals (N, 3) in the fraction
        `sunlit` (N,) of the sun; leaves (`leafy`) let light through."""
        normal = np.asarray(normal)
        facing = normal @ self.direction
        facing = 0.35 + 0.65 * np.abs(facing) if leafy else np.clip(facing, 0, None)
        up = 0.5 + 0.5 * normal[:, 2:]
        return (
            self.sun * (np.asarray(sunlit) * facing)[:, None]
            + self.sky * (0.35 + 0.65 * up)
            + self.ground * (1 - up)
        )

    def through_canopy(self, p: ArrayLike, height: float, seed: int) -> NDArray[np.float32]:
        """Computes the fraction of the sun (N,) through leaves at `height` [m] to p (N, 3) [m]."""
        p = np.asarray(p)
        climb = np.clip(height - p[:, 2:], 0, None) / self.direction[2]
        hit = p[:, :2] + climb * self.direction[:2]
        gaps = fbm(hit * 0.42, 2, seed) + 0.55 * fbm(hit * 1.7, 2, seed + 7)
        return smoothstep(0.0, 0.22, gaps)

    def past_trunks(
        self, p: ArrayLike, trunks: ArrayLike, radii: ArrayLike, height: float
    ) -> NDArray[np.float32]:
        """Computes the fraction of the sun (N,) at p (N, 3) [m] past upright trunks at (M, 2) [m]
        with `radii` (M,) [m] and a height [m]."""
        p = np.asarray(p, dtype=np.float32)
        flat = self.direction[:2] / np.linalg.norm(self.direction[:2])
        reach = (height - p[:, 2]) * np.float32(np.hypot(*self.direction[:2]) / self.direction[2])
        along_p = p[:, :2] @ flat.astype(np.float32)
        across_p = p[:, :2] @ np.array([-flat[1], flat[0]], dtype=np.float32)
        lit = np.ones(len(p), dtype=np.float32)
        for trunk, radius in zip(np.asarray(trunks), np.asarray(radii), strict=True):
            along = np.float32(trunk @ flat) - along_p
            across = np.abs(np.float32(trunk @ (-flat[1], flat[0])) - across_p)
            shaded = (along > 1.2 * radius) & (along < reach) & (across < radius + 0.3)
            near = np.flatnonzero(shaded)
            blur = 0.04 + 0.02 * along[near]  # the penumbra widens with the distance
            edge = np.clip((across[near] - radius) / blur, -1, 1)
            lit[near] = np.minimum(lit[near], 0.5 + 0.5 * edge)
        return lit


def shade(
    albedo: NDArray, irradiance: ArrayLike, haze: ArrayLike, distance: ArrayLike
) -> NDArray[np.float64]:
    """Computes colors (N, 3), sRGB, of surfaces of an albedo (N, 3), sRGB, in linear light (N, 3)
    and haze (3,), sRGB, at distances (N,) [m]."""
    return fade(develop(albedo**GAMMA * np.asarray(irradiance)), haze, distance)


def develop(linear: ArrayLike) -> NDArray[np.float32]:
    """Converts linear light to sRGB, exposed like film so that nothing clips."""
    return ((1 - np.exp(-1.25 * np.asarray(linear))) ** (1 / GAMMA)).astype(np.float32)


def fade(colors: ArrayLike, haze: ArrayLike, distance: ArrayLike) -> NDArray[np.float64]:
    """Mixes `colors` (N, 3) with `haze` (3,): exp(-distance / HAZE_RANGE) of them remains."""
    clear = np.exp(-np.asarray(distance, dtype=np.float64) / HAZE_RANGE)[:, None]
    return np.asarray(colors) * clear + np.asarray(haze) * (1 - clear)


Array = NDArray[np.floating]


class Illumination(Protocol):
    """Light baked into colors."""

    @property
    def haze(self) -> Array:
        """(3,) sRGB, the color to which all colors fade with distance."""
        ...

    def irradiance(self, p_W: Array, n_W: Array) -> Array:
        """Computes light, linear (N, 3), at p_W (N, 3) [m] with unit normals n_W (N, 3)."""
        ...


@dataclass(frozen=True, eq=False)
class Sunlight:
    """Daylight with the shadows of a distance field."""

    daylight: Daylight
    esdf: Esdf

    @property
    def haze(self) -> Array:
        return self.daylight.haze

    def irradiance(self, p_W: Array, n_W: Array) -> Array:
        sunlit = np.zeros(len(p_W))
        toward = np.flatnonzero(n_W @ self.daylight.direction > 0)
        sunlit[toward] = self._sunlit(p_W[toward] + 0.12 * n_W[toward])
        return self.daylight.irradiance(n_W, sunlit) * openness(self.esdf, p_W, n_W)[:, None]

    def _sunlit(self, p_W: Array) -> Array:
        """Computes the fraction of the sun (N,) at points p_W (N, 3) by sphere tracing. The
        narrowest passage, as an angle, determines it: distant obstacles have soft shadows."""
        lit = np.ones(len(p_W))
        active = np.arange(len(p_W))
        traveled = np.full(len(p_W), 0.05)  # [m]
        for _ in range(14):
            p_WQ = p_W[active] + traveled[active, None] * self.daylight.direction
            distance = self.esdf.distance(p_WQ)
            inside = ~np.isnan(distance)
            active, distance = active[inside], distance[inside]
            lit[active] = np.minimum(lit[active], 0.5 + 7.0 * distance / (traveled[active] + 0.5))
            traveled[active] += np.clip(distance, 0.12, 2.5)
            active = active[lit[active] > 0]
        return np.clip(lit, 0, 1)


@dataclass(frozen=True, eq=False)
class Lamplight:
    """Lamps under a roof: panels of one tint."""

    lamps: Array  # (M, 3) [m]
    tint: Array  # (3,) linear RGB
    esdf: Esdf

    @property
    def haze(self) -> Array:
        return develop(0.25 * self.tint)

    def irradiance(self, p_W: Array, n_W: Array) -> Array:
        total = np.full(len(p_W), 0.45)
        for lamp in self.lamps:
            to_lamp = lamp - p_W
            squared = np.einsum("nk,nk->n", to_lamp, to_lamp)
            facing = np.einsum("nk,nk->n", to_lamp, n_W) / np.sqrt(squared + 1e-9)
            total += 5.0 * (0.2 + 0.8 * np.clip(facing, 0, None)) / (2.0 + squared)
            total += 5.0 * (np.abs(to_lamp) < (0.6, 0.3, 0.12)).all(axis=1)  # the panel itself
        return total[:, None] * self.tint * openness(self.esdf, p_W, n_W)[:, None]


def openness(esdf: Esdf, p_W: Array, n_W: Array) -> Array:
    """Computes the fraction (N,) of the sky seen from p_W (N, 3) [m]: less in corners, where the
    distance grows slowly along the normal n_W (N, 3)."""
    visible = np.zeros(len(p_W))
    for step in (0.25, 0.7):
        distance = esdf.distance(p_W + step * n_W)
        visible += 0.5 * np.clip(np.nan_to_num(distance, nan=step) / step, 0, 1)
    return 0.42 + 0.58 * visible
