"""A forest of thin things: dead limbs on the trunks and wires between them."""

from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from splatpilot.diagrams.worlds.feasibility import TRIES, is_feasible
from splatpilot.diagrams.worlds.fittings import TIGHT_CLEARING, check_count, check_range, clear_of
from splatpilot.diagrams.worlds.forest.config import TrunksConfig
from splatpilot.diagrams.worlds.forest.forest import Forest
from splatpilot.diagrams.worlds.forest.layout import BARK
from splatpilot.diagrams.worlds.solids.blueprint import Blueprint
from splatpilot.diagrams.worlds.solids.illumination import Illumination
from splatpilot.diagrams.worlds.solids.solid import Solid
from splatpilot.diagrams.worlds.solids.surfaces import merge
from splatpilot.diagrams.worlds.solids.surfels import draw
from splatpilot.systems.collision.shapes import Capsule
from splatpilot.systems.infeasible import InfeasibleFlightError
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


def branches_blueprint(config: BranchesConfig, seed: int) -> Blueprint:
    """Grows the forest of `config` and puts limbs and wires into it.

    Raises:
        ValueError: see `forest_blueprint`.
        InfeasibleFlightError: if limbs and wires leave no route.
    """
    forest = Forest(config, seed)
    bare = forest.blueprint()
    for attempt in range(TRIES):
        thin = _limbs_and_wires(forest, config, np.random.default_rng([seed, 20, attempt]))
        blueprint = replace(bare, name="branches", solids=[*bare.solids, *thin])
        if is_feasible(blueprint):
            return replace(blueprint, gaussians=partial(_gaussians, forest, blueprint, thin))
    raise InfeasibleFlightError(
        f"branches: limbs = {config.limbs} and wires = {config.wires} leave no route in {TRIES} "
        f"draws from seed {seed}; use fewer of them or a wider spacing"
    )


def _gaussians(
    forest: Forest, blueprint: Blueprint, thin: list[Solid], light: Illumination
) -> GaussianScene:
    return merge([forest.gaussians(), draw(blueprint, thin, light)])


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
    return [s for s in thin if clear_of(s.shape, [forest.p_WS, forest.p_WG], TIGHT_CLEARING)]
