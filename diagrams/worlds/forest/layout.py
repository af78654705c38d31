"""Layout of a generated forest, for both Gaussians and distances."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import KDTree

from splatpilot.diagrams.worlds import building_blocks
from splatpilot.diagrams.worlds.solids.solid import Solid
from splatpilot.diagrams.worlds.solids.surfaces import FloorPlan
from splatpilot.diagrams.worlds.solids.textures import BIRCH, OAK, PINE
from splatpilot.systems.collision.shapes import Capsule, Sphere
from splatpilot.systems.common.validation import bounded, require, require_field


@dataclass
class TrunksConfig(building_blocks.VolumeConfig):
    """Volume and trunks of a forest."""

    length: float = bounded(
        36.0, f"[{2 * (building_blocks.INSET + building_blocks.CLEARING):g}, inf) m"
    )  # [m] along x, from 0
    width: float = bounded(16.0, "(0, inf) m")  # [m] along y, centered on 0
    # [m] Minimum distance of two trunks on the ground, axis to axis.
    spacing: float = bounded(3.0, "(0, inf) m")
    # [1/m^2] Trunks per area, drawn among those that are `spacing` apart; 0 leaves all.
    density: float = bounded(0.0, "[0, inf) 1/m^2")
    radius_min: float = bounded(0.25, "(0, inf) m")  # [m] thinnest trunk
    radius_max: float = bounded(0.45, "(0, inf) m")  # [m] thickest trunk
    lean_max: float = bounded(1.5, "[0, 10] deg")  # [deg] largest tilt of a trunk
    rocks: int = bounded(10, "[0, 1000]")  # [-] boulders, at most knee-high, fewer if cramped
    logs: int = bounded(5, "[0, 1000]")  # [-] fallen trunks on the ground, fewer if cramped
    # [m] Height of start and goal.
    flight_height: float = bounded(1.8, f"[{building_blocks.CLEARING:g}, inf) m")

    @property
    def narrowest(self) -> float:
        """The narrowest possible gap between two trunks [m]."""
        tilt = self.height * np.tan(np.deg2rad(self.lean_max))
        return float(self.spacing - 2 * self.radius_max - 2 * tilt)

    def check(self) -> None:
        super().check()
        # A narrower forest can be blocked by one trunk.
        narrow = 2 * (self.radius_max + building_blocks.PASSAGE)
        require_field(self, "width", self.width >= narrow, f"at least {narrow:g} m")
        highest = self.height - building_blocks.CLEARING
        condition = f"at most height - {building_blocks.CLEARING:g} m = {highest:g} m"
        require_field(self, "flight_height", self.flight_height <= highest, condition)
        building_blocks.require_order(self, "radius_min", "radius_max")
        # The vehicle fits between any two trunks.
        spacing = self.spacing + building_blocks.PASSAGE - self.narrowest
        require_field(self, "spacing", self.spacing >= spacing, f"at least {spacing:.2f} m")


@dataclass
class ForestConfig(TrunksConfig):
    """A forest. Not a base of others: Drake would write these to YAML as plain forests."""


MARGIN = 14.0  # [m], width of the belt of trees around the flyable volume
BURIED = 1.0  # [m], depth of trunks in the ground

BARK = {OAK: "oak", PINE: "pine", BIRCH: "birch"}


@dataclass(frozen=True, eq=False)
class Trees:
    """N trees with round, straight trunks."""

    base: NDArray[np.float64]  # (N, 2) [m], where the axis meets the ground
    lean: NDArray[np.float64]  # (N, 2), shift of the axis in x and y per meter of height
    radius: NDArray[np.float64]  # (N,) [m]
    height: NDArray[np.float64]  # (N,) [m], of the tip
    species: NDArray[np.int64]  # (N,), OAK, PINE or BIRCH

    def __len__(self) -> int:
        return len(self.base)

    def at(self, z: float) -> NDArray[np.float64]:
        """Returns the points (N, 3) of the axes at height z."""
        return np.column_stack([self.base + z * self.lean, np.full(len(self), z)])


@dataclass(frozen=True, eq=False)
class ForestLayout(FloorPlan):
    """Trees, rocks and fallen logs on the ground z = 0."""

    trees: Trees
    rocks: NDArray[np.float64]  # (M, 4) [m], spheres: center and radius
    logs: NDArray[np.float64]  # (L, 7) [m], capsules: two ends and radius

    def clearance(self, p: ArrayLike) -> NDArray[np.float64]:
        """Computes horizontal distances (N,) [m] of p (N, 2 or more) to trees, rocks and logs."""
        p = np.asarray(p)[:, :2]
        gap, nearest = KDTree(self.trees.base).query(p)
        clearance = gap - self.trees.radius[nearest]
        for rock in self.rocks:  # cut by the ground in a smaller circle
            foot = np.sqrt(rock[3] ** 2 - rock[2] ** 2)
            clearance = np.minimum(clearance, np.linalg.norm(p - rock[:2], axis=1) - foot)
        for log in self.logs:
            axis = log[3:5] - log[:2]
            along = np.clip((p - log[:2]) @ axis / (axis @ axis), 0, 1)
            foot = np.sqrt(log[6] ** 2 - log[2] ** 2)
            gap = np.linalg.norm(p - log[:2] - along[:, None] * axis, axis=1)
            clearance = np.minimum(clearance, gap - foot)
        return clearance

    def solids(self) -> tuple[list[Solid], list[Solid]]:
        """Returns the solids that can be nearest to a point of the volume, and the other solids.
        The ground is never farther from such a point than the volume is high."""
        ceiling, trees = self.upper[2], self.trees
        near = self.outside(trees.base) - trees.radius - ceiling * np.hypot(*trees.lean.T) < ceiling
        foot, top = trees.at(-BURIED), trees.at(ceiling + 2)
        tips = np.column_stack([trees.base, 0.85 * trees.height])
        tips[:, :2] += tips[:, 2:] * trees.lean
        solids, far, upper = [building_blocks.ground("forest_floor")], [], []
        for k, radius in enumerate(trees.radius):
            material = BARK[trees.species[k]]
            trunk = Solid(Capsule(foot[k], top[k], float(radius)), material, k)
            (solids if near[k] else far).append(trunk)
            if tips[k, 2] > ceiling + 2.5:
                upper.append(Solid(Capsule(top[k], tips[k], float(0.55 * radius)), material, k))
        for k, log in enumerate(self.logs):
            solids.append(Solid(Capsule(log[:3], log[3:6], float(log[6])), "oak", k))
        for k, rock in enumerate(self.rocks):
            solids.append(Solid(Sphere(rock[:3], float(rock[3])), "stone", k))
        return solids, far + upper


def lay_out(config: TrunksConfig, rng: np.random.Generator, clear: ArrayLike) -> ForestLayout:
    """Draws a layout that leaves discs of radius `CLEARING` about `clear` (K, 2) [m] open."""
    clear, clearance = np.asarray(clear), building_blocks.CLEARING
    lower, upper = config.plan.lower, config.plan.upper
    base = building_blocks.poisson_disk(lower[:2] - MARGIN, upper[:2] + MARGIN, config.spacing, rng)
    if config.density > 0.0:
        count = round(config.density * float(np.prod(upper[:2] - lower[:2] + 2.0 * MARGIN)))
        condition = f"at most {len(base)} trunks at this spacing"
        require(count <= len(base), "density", condition, count, "lower it, or the spacing")
        base = base[np.sort(rng.permutation(len(base))[:count])]
    N = len(base)
    radius = rng.uniform(config.radius_min, config.radius_max, N)
    angle, slope = rng.uniform(0, 2 * np.pi, N), np.tan(np.deg2rad(config.lean_max))
    lean = slope * rng.uniform(0, 1, (N, 1)) * np.column_stack([np.cos(angle), np.sin(angle)])
    trees = Trees(
        base=base,
        lean=lean,
        radius=radius,
        height=config.height + 14 * radius * rng.uniform(0.8, 1.6, N) + 3.0,
        species=rng.choice([PINE, OAK, BIRCH], size=N, p=[0.5, 0.35, 0.15]),
    )
    blocked = radius + config.height * np.linalg.norm(lean, axis=1) + clearance
    gap = np.linalg.norm(base[:, None] - clear, axis=-1)
    open_ = (gap > blocked[:, None]).all(axis=1)
    trees = Trees(*(getattr(trees, name)[open_] for name in Trees.__dataclass_fields__))
    require(len(trees.base), "density", "that of one trunk or more", config.density, "raise it")

    # Rocks and logs: apart from everything else, and below the flight height.
    taken = [*np.column_stack([trees.base, trees.radius]), *([*p, clearance] for p in clear)]
    rocks, logs = [], []
    for _ in range(config.rocks):
        r = rng.uniform(0.25, 0.6)
        p = _free_spot(rng, lower, upper, np.array(taken), r)
        if p is not None:
            rocks.append([*p, -0.5 * r, r])
            taken.append([*p, r])
    for _ in range(config.logs):
        r, half, angle = rng.uniform(0.1, 0.18), rng.uniform(0.6, 1.1), rng.uniform(0, np.pi)
        p = _free_spot(rng, lower, upper, np.array(taken), half + r)
        if p is not None:
            d = half * np.array([np.cos(angle), np.sin(angle)])
            logs.append([*(p - d), 0.6 * r, *(p + d), 0.6 * r, r])
            taken.append([*p, half + r])
    return ForestLayout(lower, upper, trees, np.reshape(rocks, (-1, 4)), np.reshape(logs, (-1, 7)))


def _free_spot(
    rng: np.random.Generator, lower: NDArray, upper: NDArray, taken: NDArray, radius: float
) -> NDArray[np.float64] | None:
    """Draws the center (2,) of a disc apart from discs `taken` (K, 3): x, y, radius."""
    draws = rng.uniform(lower[:2], upper[:2], (100, 2))
    gap = np.linalg.norm(draws[:, None] - taken[:, :2], axis=-1) - taken[:, 2] - radius
    free = (gap > 0.15).all(axis=1)
    return draws[np.argmax(free)] if free.any() else None
