"""A forest of thin things: dead limbs on the trunks and wires between them."""

from dataclasses import dataclass, replace

import numpy as np

from splatpilot.diagrams.worlds.feasibility import CLEARANCE, TRIES, is_feasible
from splatpilot.diagrams.worlds.fittings import check_count, check_range, clear_of
from splatpilot.diagrams.worlds.forest.config import TrunksConfig
from splatpilot.diagrams.worlds.forest.forest import Forest
from splatpilot.diagrams.worlds.forest.layout import BARK
from splatpilot.diagrams.worlds.solids.blueprint import Blueprint
from splatpilot.diagrams.worlds.solids.solid import Solid
from splatpilot.diagrams.worlds.solids.surfaces import merged
from splatpilot.diagrams.worlds.solids.surfels import draw
from splatpilot.systems.collision.esdf import Esdf
from splatpilot.systems.collision.shapes import Capsule
from splatpilot.systems.splats.gaussian_scene import GaussianScene


@dataclass
class BranchesConfig(TrunksConfig):
    """A forest whose trunks have limbs in the flyable volume, and wires across it."""

    spacing: float = 4.0
    radius_min: float = 0.12
    radius_max: float = 0.28
    limbs: int = 5  # [-] on each trunk
    limb_length: float = 1.6  # [m] of the longest
    wires: int = 8  # [-] from side to side
    thickness_min: float = 0.02  # [m] diameter of the thinnest limb or wire
    thickness_max: float = 0.04  # [m] of the thickest

    def validate(self) -> None:
        """Raises ValueError for the first value with which no forest can be grown."""
        super().validate()
        check_count(self, "limbs", "wires")
        check_range(self, "thickness_min", "thickness_max")
        if not 0.2 <= self.limb_length <= 5:
            raise ValueError(f"limb_length = {self.limb_length} m must be 0.2 to 5 m")


class Branches(Forest):
    """What `config` and `seed` determine of such a forest.

    Raises:
        ValueError: see `Forest`; or if limbs and wires leave no way.
    """

    def __init__(self, config: BranchesConfig, seed: int) -> None:
        super().__init__(config, seed)
        bare = super().blueprint()
        for attempt in range(TRIES):
            self.thin = _limbs_and_wires(self, config, np.random.default_rng([seed, 20, attempt]))
            self._blueprint = replace(bare, name="branches", solids=[*bare.solids, *self.thin])
            if is_feasible(self._blueprint):
                return
        raise ValueError(
            f"branches: limbs = {config.limbs} and wires = {config.wires} leave no way in {TRIES} "
            f"draws from seed {seed}; use fewer of them or a wider spacing"
        )

    def blueprint(self) -> Blueprint:
        return self._blueprint

    def gaussians(self, esdf: Esdf) -> GaussianScene:
        light = self._blueprint.light(esdf)
        return merged([super().gaussians(esdf), draw(self._blueprint, self.thin, light)])


def _limbs_and_wires(
    forest: Forest, config: BranchesConfig, rng: np.random.Generator
) -> list[Solid]:
    trees, layout = forest.layout.trees, forest.layout
    thin = []
    for i in np.flatnonzero(layout.outside(trees.base) == 0):
        for z in rng.uniform(0.7, config.height - 0.3, config.limbs):
            foot = np.array([*(trees.base[i] + z * trees.lean[i]), z])
            azimuth, rise = rng.uniform(0, 2 * np.pi), rng.uniform(-0.15, 0.7)
            way = np.array([np.cos(azimuth), np.sin(azimuth), rise])
            tip = foot + (trees.radius[i] + rng.uniform(0.4, 1.0) * config.limb_length) * way
            radius = rng.uniform(config.thickness_min, config.thickness_max) / 2
            thin.append(Solid(Capsule(foot, tip, float(radius)), BARK[trees.species[i]], int(i)))
    half = config.width / 2
    for k in range(config.wires):
        x, z = rng.uniform(4.0, config.length - 4.0), rng.uniform(0.8, config.height - 0.4)
        ends = np.array([[x, -half, z], [x, half, z]])
        ends[:, [0, 2]] += rng.uniform(-0.8, 0.8, (2, 2))
        radius = rng.uniform(config.thickness_min, config.thickness_max) / 2
        thin.append(Solid(Capsule(ends[0], ends[1], float(radius)), "cable", k))
    return [s for s in thin if clear_of(s.shape, [forest.p_WS, forest.p_WG], CLEARANCE + 0.1)]
