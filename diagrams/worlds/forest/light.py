"""The light in a forest: the sun past the trunks and through the leaves."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from splatpilot.diagrams.worlds.forest.layout import ForestLayout
from splatpilot.diagrams.worlds.solids.light import Daylight, shade
from splatpilot.diagrams.worlds.solids.surfaces import Surfels, to_gaussians
from splatpilot.diagrams.worlds.solids.textures import smoothstep
from splatpilot.systems.splats.gaussian_scene import GaussianScene


@dataclass(frozen=True, eq=False)
class ForestLight:
    """Daylight in which trees throw their shadows: an `Illumination`."""

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
        """The patches as Gaussians of `albedo` (N, 3), sRGB, and `opacity`, a number or (N,)."""
        irradiance = self.daylight.irradiance(surfels.n, self._sunlit(surfels.p))
        colors = shade(albedo, irradiance, self.haze, self.layout.outside(surfels.p))
        return to_gaussians(surfels, colors, opacity)

    def _sunlit(self, p: NDArray) -> NDArray:
        """Part of the sun (N,) in [0, 1] that trunks and leaves let through to p (N, 3) [m]."""
        near, trees, top = self._shading, self.layout.trees, float(self.layout.upper[2]) + 3
        past = self.daylight.past_trunks(p, trees.at(2.0)[near, :2], trees.radius[near], top)
        return past * self.daylight.through_canopy(p, top, self.seed)

    @cached_property
    def _shading(self) -> NDArray[np.bool_]:
        """Which trees are near enough to shade the volume."""
        return self.layout.outside(self.layout.trees.base) < self.layout.upper[2]
