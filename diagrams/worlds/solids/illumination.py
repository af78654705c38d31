"""How much light reaches the surfaces of a world: by the sun past obstacles, or by lamps."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from splatpilot.diagrams.worlds.solids.light import Daylight, develop
from splatpilot.systems.collision.esdf import Esdf

Array = NDArray[np.floating]


class Illumination(Protocol):
    """Light baked into colours."""

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
        towards = np.flatnonzero(n_W @ self.daylight.direction > 0)
        sunlit[towards] = self._sunlit(p_W[towards] + 0.12 * n_W[towards])
        # What is flat on something else gets little sky.
        return self.daylight.irradiance(n_W, sunlit) * openness(self.esdf, p_W, n_W)[:, None]

    def _sunlit(self, p_W: Array) -> Array:
        """Part of the sun (N,) in [0, 1] that reaches points p_W (N, 3).

        Steps towards the sun as far as the distance allows; the narrowest passage, as an angle,
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
