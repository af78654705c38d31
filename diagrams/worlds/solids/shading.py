"""How much light reaches the surfaces of a world: by the sun past obstacles, or by lamps."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from splatpilot.diagrams.worlds.solids.textures import fbm, smoothstep
from splatpilot.systems.collision.esdf import Esdf

GAMMA = 2.2

HAZE_RANGE = 16.0
"""[m], way through the surroundings in which light fades by a factor e."""


@dataclass(frozen=True, eq=False)
class Daylight:
    """Irradiance, linear red, green, blue; a white surface under 1 shows as bright as it can."""

    direction: NDArray[np.float64]  # (3,), unit vector from the ground to the sun, in W
    sun: NDArray[np.float64]  # (3,) linear rgb
    sky: NDArray[np.float64]  # (3,) linear rgb
    ground: NDArray[np.float64]  # (3,) linear rgb
    haze: NDArray[np.float64]  # (3,) sRGB, what everything fades to with distance

    @classmethod
    def sample(cls, rng: np.random.Generator) -> "Daylight":
        """Draws the hour: the lower the sun, the warmer its light."""
        azimuth, elevation = rng.uniform(-np.pi, np.pi), np.deg2rad(rng.uniform(32, 58))
        warmth = 0.8 * float(smoothstep(58, 32, np.rad2deg(elevation)))
        return cls(
            direction=np.array(
                [
                    np.cos(elevation) * np.cos(azimuth),
                    np.cos(elevation) * np.sin(azimuth),
                    np.sin(elevation),
                ]
            ),
            sun=2.6 * np.array([1.0, 0.93 - 0.08 * warmth, 0.80 - 0.22 * warmth]),
            sky=0.74 * np.array([0.93, 1.0, 0.99]),
            ground=0.33 * np.array([1.05, 1.0, 0.72]),
            haze=np.array([0.80, 0.86, 0.86]) + warmth * np.array([0.05, 0.0, -0.06]),
        )

    def irradiance(
        self, normal: ArrayLike, sunlit: ArrayLike, leafy: bool = False
    ) -> NDArray[np.float64]:
        """The light, linear (N, 3), that falls on surfaces.

        Args:
            normal: (N, 3), unit, in W.
            sunlit: (N,) in [0, 1], the part of the sun that reaches the surface.
            leafy: leaves let light through, so both their sides are lit by sun on either.
        """
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
        """Part of the sun that gaps in the leaves at `height` [m] let through to p (N, 3) [m]."""
        p = np.asarray(p)
        climb = np.clip(height - p[:, 2:], 0, None) / self.direction[2]
        hit = p[:, :2] + climb * self.direction[:2]
        gaps = fbm(hit * 0.42, 2, seed) + 0.55 * fbm(hit * 1.7, 2, seed + 7)
        return smoothstep(0.0, 0.22, gaps)

    def past_trunks(
        self, p: ArrayLike, trunks: ArrayLike, radii: ArrayLike, height: float
    ) -> NDArray[np.float32]:
        """Part of the sun that upright trunks leave to the points p (N, 3) [m].

        Args:
            trunks: (M, 2) [m], where they stand.
            radii: (M,) [m].
            height: [m], where the crowns begin and trunks throw no shadow of their own.
        """
        p = np.asarray(p, dtype=np.float32)
        flat = self.direction[:2] / np.linalg.norm(self.direction[:2])
        reach = (height - p[:, 2]) * np.float32(np.hypot(*self.direction[:2]) / self.direction[2])
        along_p = p[:, :2] @ flat.astype(np.float32)
        across_p = p[:, :2] @ np.array([-flat[1], flat[0]], dtype=np.float32)
        lit = np.ones(len(p), dtype=np.float32)
        for trunk, radius in zip(np.asarray(trunks), np.asarray(radii), strict=True):
            along = np.float32(trunk @ flat) - along_p
            across = np.abs(np.float32(trunk @ (-flat[1], flat[0])) - across_p)
            near = np.flatnonzero(
                (along > 1.2 * radius) & (along < reach) & (across < radius + 0.3)
            )
            blur = 0.04 + 0.02 * along[near]  # penumbra widens with the way
            edge = np.clip((across[near] - radius) / blur, -1, 1)
            lit[near] = np.minimum(lit[near], 0.5 + 0.5 * edge)
        return lit


def shade(
    albedo: NDArray, irradiance: ArrayLike, haze: ArrayLike, distance: ArrayLike
) -> NDArray[np.float64]:
    """Colors (N, 3), sRGB, of surfaces as they are seen.

    Args:
        albedo: (N, 3), sRGB, not negative.
        irradiance: (N, 3), linear, the light that falls on them.
        haze: (3,), sRGB, what they fade to.
        distance: (N,) [m], the way through the haze.
    """
    return fade(develop(albedo**GAMMA * np.asarray(irradiance)), haze, distance)


def develop(linear: ArrayLike) -> NDArray[np.float32]:
    """The sRGB colors of linear light: exposed like film, so that nothing clips."""
    return ((1 - np.exp(-1.25 * np.asarray(linear))) ** (1 / GAMMA)).astype(np.float32)


def fade(colors: ArrayLike, haze: ArrayLike, distance: ArrayLike) -> NDArray[np.float64]:
    """`colors` (N, 3) mixed with `haze` (3,): exp(-distance / HAZE_RANGE) of them is left after
    `distance` (N,) [m]."""
    clear = np.exp(-np.asarray(distance, dtype=np.float64) / HAZE_RANGE)[:, None]
    return np.asarray(colors) * clear + np.asarray(haze) * (1 - clear)


Array = NDArray[np.floating]


class Illumination(Protocol):
    """Light baked into colors."""

    @property
    def haze(self) -> Array:
        """(3,) sRGB, what everything fades to with distance."""
        ...

    def irradiance(self, p_W: Array, n_W: Array) -> Array:
        """Light, linear (N, 3), on surfaces at p_W (N, 3) [m] with unit normals n_W (N, 3)."""
        ...


@dataclass(frozen=True, eq=False)
class Sunlight:
    """Daylight with the shadows that the obstacles of a distance field throw."""

    daylight: Daylight
    esdf: Esdf

    @property
    def haze(self) -> Array:
        return self.daylight.haze

    def irradiance(self, p_W: Array, n_W: Array) -> Array:
        sunlit = np.zeros(len(p_W))
        toward = np.flatnonzero(n_W @ self.daylight.direction > 0)
        sunlit[toward] = self._sunlit(p_W[toward] + 0.12 * n_W[toward])
        # What is flat on something else gets little sky.
        return self.daylight.irradiance(n_W, sunlit) * openness(self.esdf, p_W, n_W)[:, None]

    def _sunlit(self, p_W: Array) -> Array:
        """Part of the sun (N,) in [0, 1] that reaches points p_W (N, 3).

        Steps toward the sun as far as the distance allows; the narrowest passage, as an angle,
        tells how much of the sun is covered: shadows are softer the further away what throws them.
        """
        lit = np.ones(len(p_W))
        going = np.arange(len(p_W))
        way = np.full(len(p_W), 0.05)  # [m]
        for _ in range(14):
            distance = self.esdf.distance(p_W[going] + way[going, None] * self.daylight.direction)
            inside = ~np.isnan(distance)  # beyond the bounds nothing throws shadows
            going, distance = going[inside], distance[inside]
            lit[going] = np.minimum(lit[going], 0.5 + 7.0 * distance / (way[going] + 0.5))
            way[going] += np.clip(distance, 0.12, 2.5)
            going = going[lit[going] > 0]
        return np.clip(lit, 0, 1)


@dataclass(frozen=True, eq=False)
class Lamplight:
    """Lamps under a roof: white panels, warmer or colder from room to room."""

    lamps: Array  # (M, 3) [m]
    tint: Array  # (3,) linear rgb
    esdf: Esdf
    strength: float = 5.0

    @property
    def haze(self) -> Array:
        return develop(0.25 * self.tint)

    def irradiance(self, p_W: Array, n_W: Array) -> Array:
        total = np.full(len(p_W), 0.45)
        for lamp in self.lamps:
            to_lamp = lamp - p_W
            squared = np.einsum("nk,nk->n", to_lamp, to_lamp)
            facing = np.einsum("nk,nk->n", to_lamp, n_W) / np.sqrt(squared + 1e-9)
            total += self.strength * (0.2 + 0.8 * np.clip(facing, 0, None)) / (2.0 + squared)
            total += 5.0 * (np.abs(to_lamp) < (0.6, 0.3, 0.12)).all(axis=1)  # the panel itself
        return total[:, None] * self.tint * openness(self.esdf, p_W, n_W)[:, None]


def openness(esdf: Esdf, p_W: Array, n_W: Array) -> Array:
    """Part (N,) of the sky that surfaces at p_W (N, 3) [m] see: less in corners, where the distance
    grows more slowly along the normal n_W (N, 3) than the way."""
    part = np.zeros(len(p_W))
    for way in (0.25, 0.7):
        distance = esdf.distance(p_W + way * n_W)
        part += 0.5 * np.clip(np.nan_to_num(distance, nan=way) / way, 0, 1)
    return 0.42 + 0.58 * part
