"""Obstacle fields and halls: clutter, branches and wires, walls, barriers."""

from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RollPitchYaw, RotationMatrix
from scipy.spatial.transform import Rotation

from splatpilot.diagrams.worlds import building_blocks as blocks
from splatpilot.diagrams.worlds.feasibility import TRIES, is_feasible, until_feasible
from splatpilot.diagrams.worlds.forest.forest import Forest, trees_around
from splatpilot.diagrams.worlds.forest.layout import BARK, TrunksConfig
from splatpilot.diagrams.worlds.solids.solid import Solid, WorldSpec, draw
from splatpilot.diagrams.worlds.solids.surfaces import FloorPlan, merge
from splatpilot.systems.collision.shapes import Capsule, Sphere
from splatpilot.systems.common.provenance import InfeasibleFlightError
from splatpilot.systems.common.validation import bounded, require_field

_SPHERES = ["stone", "concrete", "foliage", "hazard", "metal"]
_BOXES = ["crate", "wood", "metal", "hazard", "brick", "concrete", "signage", "fabric"]


@dataclass
class ClutterConfig(blocks.VolumeConfig):
    """An open field with spheres and boxes: pillars, or floating boxes in any attitude."""

    length: float = bounded(36.0, "[6, 200] m")  # [m] along x: from 0 to length
    width: float = bounded(20.0, "[4, 200] m")  # [m] along y, centered on 0
    height: float = bounded(6.0, "[3, 100] m")  # [m] along z
    spheres: int = bounded(10, "[0, 1000]")  # [-] spheres
    sphere_min: float = bounded(0.6, "(0, 100] m")  # [m] smallest radius
    sphere_max: float = bounded(1.8, "(0, 100] m")  # [m] largest radius
    boxes: int = bounded(20, "[0, 1000]")  # [-] boxes
    half_min: float = bounded(0.3, "(0, 100] m")  # [m] smallest half edge of a box
    half_max: float = bounded(0.9, "(0, 100] m")  # [m] largest half edge
    # If true, boxes float in any attitude. Otherwise they are pillars on the ground, at least 2 m
    # high, that lean up to `lean_max`.
    floating: bool = False
    lean_max: float = bounded(15.0, "[0, 45] deg")  # [deg] largest tilt of a pillar

    def check(self) -> None:
        super().check()
        blocks.require_order(self, "sphere_min", "sphere_max")
        blocks.require_order(self, "half_min", "half_max")


@until_feasible
def clutter_spec(config: ClutterConfig, seed: int, rng: np.random.Generator) -> WorldSpec:
    """Draws the field of `config`: obstacles may overlap, but not near start and goal."""
    plan = config.plan
    ends = blocks.start_and_goal(plan, rng)
    obstacles: list[Solid] = []
    for make, number in ((_sphere, config.spheres), (_box, config.boxes)):
        for _ in range(number):
            for _ in range(50):  # again, if it is too near the start or goal
                solid = make(config, plan, rng)
                if blocks.has_clearance(solid.shape, list(ends), blocks.CLEARING):
                    obstacles.append(solid)
                    break
    hour, light = blocks.daylight(rng)
    solids = [blocks.ground(("grass", "paving", "concrete")[rng.integers(3)]), *obstacles]
    trees = trees_around(plan, hour, seed)
    return blocks.volume_spec("clutter", config, seed, solids, ends, light, trees)


def _sphere(config: ClutterConfig, plan: FloorPlan, rng: np.random.Generator) -> Solid:
    radius = rng.uniform(config.sphere_min, config.sphere_max)
    p = rng.uniform(plan.lower, plan.upper)
    return Solid(Sphere(p, float(radius)), *blocks.draw_paint(_SPHERES, rng))


def _box(config: ClutterConfig, plan: FloorPlan, rng: np.random.Generator) -> Solid:
    half = rng.uniform(config.half_min, config.half_max, 3)
    p = rng.uniform(plan.lower, plan.upper)
    if config.floating:
        R = RotationMatrix(Rotation.random(rng=rng).as_matrix())
    else:
        lean = np.deg2rad(config.lean_max) * np.sqrt(rng.uniform())
        azimuth = rng.uniform(0, 2 * np.pi)
        roll, pitch = lean * np.cos(azimuth), lean * np.sin(azimuth)
        R = RotationMatrix(RollPitchYaw(roll, pitch, rng.uniform(0, np.pi)))
        top = rng.uniform(2.0, max(config.height, 2.5))
        half[2] = top / 2 + 0.3
        p[2] = top / 2 - 0.3
    return blocks.rotated_box(p, R, 2 * half, *blocks.draw_paint(_BOXES, rng))


@dataclass
class BranchesConfig(TrunksConfig):
    """A forest whose trunks have limbs in the flyable volume, and wires across it."""

    spacing: float = bounded(4.0, "(0, inf) m")
    radius_min: float = bounded(0.12, "(0, inf) m")
    radius_max: float = bounded(0.28, "(0, inf) m")
    limbs: int = bounded(5, "[0, 1000]")  # [-] on each trunk
    limb_length: float = bounded(1.6, "[0.2, 5] m")  # [m] of the longest
    wires: int = bounded(8, "[0, 1000]")  # [-] from side to side
    thickness_min: float = bounded(0.02, "(0, 100] m")  # [m] of the thinnest limb or wire
    thickness_max: float = bounded(0.04, "(0, 100] m")  # [m] of the thickest

    def check(self) -> None:
        super().check()
        blocks.require_order(self, "thickness_min", "thickness_max")


def branches_spec(config: BranchesConfig, seed: int) -> WorldSpec:
    """Grows the forest of `config` with limbs and wires."""
    forest = Forest(config, seed)
    bare = forest.spec()
    for attempt in range(TRIES):
        thin = _limbs_and_wires(forest, config, np.random.default_rng([seed, 20, attempt]))
        spec = replace(bare, name="branches", solids=[*bare.solids, *thin])
        if is_feasible(spec):
            seen = lambda light, s=spec, t=thin: merge([forest.gaussians(), draw(s, t, light)])  # noqa: E731
            return replace(spec, gaussians=seen)
    raise InfeasibleFlightError(
        f"branches: limbs = {config.limbs} and wires = {config.wires} leave no route in {TRIES} "
        f"draws from seed {seed}; use fewer of them or a wider spacing"
    )


def _limbs_and_wires(
    forest: Forest, config: BranchesConfig, rng: np.random.Generator
) -> list[Solid]:
    trees, layout = forest.layout.trees, forest.layout
    thin = []
    for i in np.flatnonzero(layout.outside(trees.base) == 0):
        for z in rng.uniform(0.7, config.height - 0.3, config.limbs):
            foot = np.array([*(trees.base[i] + z * trees.lean[i]), z])
            azimuth, rise = rng.uniform(0, 2 * np.pi), rng.uniform(-0.15, 0.7)
            direction = np.array([np.cos(azimuth), np.sin(azimuth), rise])
            reach = trees.radius[i] + rng.uniform(0.4, 1.0) * config.limb_length
            tip = foot + reach * direction
            radius = rng.uniform(config.thickness_min, config.thickness_max) / 2
            thin.append(Solid(Capsule(foot, tip, float(radius)), BARK[trees.species[i]], int(i)))
    half = config.width / 2
    for k in range(config.wires):
        x, z = rng.uniform(4.0, config.length - 4.0), rng.uniform(0.8, config.height - 0.4)
        ends = np.array([[x, -half, z], [x, half, z]])
        ends[:, [0, 2]] += rng.uniform(-0.8, 0.8, (2, 2))
        radius = rng.uniform(config.thickness_min, config.thickness_max) / 2
        thin.append(Solid(Capsule(ends[0], ends[1], float(radius)), "cable", k))
    clear = [forest.p_WS, forest.p_WG], blocks.TIGHT_CLEARING
    return [solid for solid in thin if blocks.has_clearance(solid.shape, *clear)]


PATTERNS = "big_wall", "u_trap", "slits", "slalom"

_FACADES = ["brick", "brick", "concrete", "metal", "wood", "plaster"]
_paint = partial(blocks.draw_paint, ["brick", "concrete", "metal", "wood", "foliage"])


@dataclass
class WallsConfig(blocks.VolumeConfig):
    """A roofless hall with walls as high as itself in between."""

    # Arrangement of the walls across.
    pattern: str = bounded("slalom", f"{{{', '.join(PATTERNS)}}}")
    width: float = bounded(14.0, "(0, 200] m")  # [m] along y, centered on 0
    # [m] Length of the wall across: all of big_wall, the back of u_trap, each wall of slalom.
    wall: float = bounded(10.4, "(0, 200] m")
    depth: float = bounded(6.0, "(0, 200] m")  # [m] of the cul-de-sac of u_trap
    walls: int = bounded(4, "[1, 20]")  # [-] walls of slalom, from one side and the other in turn
    # [m] Width of the slit in each wall of slits, from start to goal.
    slits: list[float] = bounded(lambda: [1.4, 1.25, 1.1, 1.0], f"[{blocks.PASSAGE:.3f}, 100] m")

    def check(self) -> None:
        super().check()
        if self.pattern == "slits":
            half = self.width / 2
            narrow = all(slit <= half for slit in self.slits)
            require_field(self, "slits", narrow, f"at most half the width, {half:g} m")
        else:
            widest = self.width - blocks.PASSAGE
            require_field(self, "wall", self.wall <= widest, f"at most {widest:.2f} m, for a gap")
        crossed = {"slits": len(self.slits), "slalom": self.walls}.get(self.pattern, 1)
        shortest = 2 * blocks.INSET + 2.0 * (crossed + 1) + self.depth * (self.pattern == "u_trap")
        condition = f"at least {shortest:g} m for the walls across"
        require_field(self, "length", self.length >= shortest, condition)


@until_feasible
def walls_spec(config: WallsConfig, seed: int, rng: np.random.Generator) -> WorldSpec:
    """Builds the hall of `config`. `big_wall` leaves a gap at either side of one wall; `u_trap`
    opens a cul-de-sac toward the start; the walls of `slits` have one slit each, away from the
    last; those of `slalom` leave gaps at alternating sides."""
    plan = config.plan
    across = {"big_wall": _big_wall, "u_trap": _u_trap, "slits": _slits, "slalom": _slalom}
    p_WS, p_WG = blocks.start_and_goal(plan, rng)
    if config.pattern in ("big_wall", "u_trap"):  # both block the straight line
        p_WS[1], p_WG[1] = 0.3 * p_WS[1], 0.3 * p_WG[1]
    obstacles = across[config.pattern](config, rng)
    sides = blocks.hall(plan, _FACADES, rng)
    signs = blocks.signs_in(sides, 3, 1, rng)
    signs += [sign for wall in obstacles for sign in blocks.signs_on(wall, 0, 1, rng)]
    hour, light = blocks.daylight(rng)
    floor = blocks.ground(("paving", "grass", "concrete")[rng.integers(3)])
    solids = [floor, *sides, *obstacles, *signs]
    trees = trees_around(plan, hour, seed)
    return blocks.volume_spec(config.pattern, config, seed, solids, (p_WS, p_WG), light, trees)


def _across(config: WallsConfig, x: float, y0: float, y1: float, material: str, seed: int) -> Solid:
    """Builds a wall across the hall, its middle at x, from y0 to y1 [m]."""
    return blocks.box(
        (x - blocks.WALL / 2, y0, 0), (x + blocks.WALL / 2, y1, config.height), material, seed
    )


def _big_wall(config: WallsConfig, rng: np.random.Generator) -> list[Solid]:
    spare = (config.width - config.wall) / 2  # [m] at either side of a wall in the middle
    x = rng.uniform(0.42, 0.58) * config.length
    y = rng.choice([-1, 1]) * rng.uniform(0.3, 0.7) * spare
    return [_across(config, x, y - config.wall / 2, y + config.wall / 2, *_paint(rng))]


def _u_trap(config: WallsConfig, rng: np.random.Generator) -> list[Solid]:
    spare = (config.width - config.wall) / 2
    x = rng.uniform(0.58, 0.66) * config.length
    y = rng.uniform(-0.4, 0.4) * spare
    low, high = y - config.wall / 2, y + config.wall / 2
    paint = _paint(rng)
    x0, x1, wall, height = x - config.depth, x - blocks.WALL / 2, blocks.WALL, config.height
    starts = low, high - wall
    sides = [blocks.box((x0, a, 0), (x1, a + wall, height), *paint) for a in starts]
    return [_across(config, x, low, high, *paint), *sides]


def _stations(config: WallsConfig, number: int, rng: np.random.Generator) -> NDArray:
    """Draws positions (number,) [m] along x, about evenly between start and goal."""
    step = (config.length - 2 * blocks.INSET) / (number + 1)
    return blocks.INSET + step * (np.arange(1, number + 1) + rng.uniform(-0.1, 0.1, number))


def _slits(config: WallsConfig, rng: np.random.Generator) -> list[Solid]:
    half = config.width / 2
    walls, last = [], rng.uniform(-half, half)
    for x, slit in zip(_stations(config, len(config.slits), rng), config.slits, strict=True):
        reach = half - slit / 2 - 0.5
        draws = rng.uniform(-reach, reach, 50)
        y = draws[np.argmax(np.abs(draws - last) > 0.25 * config.width)]
        paint = _paint(rng)
        walls.append(_across(config, x, -half, y - slit / 2, *paint))
        walls.append(_across(config, x, y + slit / 2, half, *paint))
        last = y
    return walls


def _slalom(config: WallsConfig, rng: np.random.Generator) -> list[Solid]:
    half, side = config.width / 2, int(rng.integers(2))
    walls = []
    for k, x in enumerate(_stations(config, config.walls, rng)):
        ends = (-half, config.wall - half) if (k + side) % 2 else (half - config.wall, half)
        walls.append(_across(config, x, *ends, *_paint(rng)))
    return walls


_MATERIALS = ["brick", "concrete", "hazard", "wood", "metal"]


@dataclass
class OverUnderConfig(blocks.VolumeConfig):
    """A roofed hall with barriers from wall to wall."""

    barriers: int = bounded(5, "[1, 50]")  # [-] over and under in turn; the first is random
    over: float = bounded(2.8, "(0, 200] m")  # [m] height of barriers on the floor
    # [m] Height of the lower edge of barriers that hang from the roof.
    under: float = bounded(1.9, f"[{blocks.PASSAGE:.3f}, 200] m")

    def check(self) -> None:
        super().check()
        highest = self.height - blocks.PASSAGE
        require_field(self, "over", self.over <= highest, f"at most {highest:.2f} m, for a gap")
        require_field(self, "under", self.under < self.height, f"below height, {self.height:g} m")
        shortest = 2 * blocks.INSET + 2.5 * (self.barriers + 1)
        condition = f"at least {shortest:g} m for the barriers"
        require_field(self, "length", self.length >= shortest, condition)


@until_feasible
def over_under_spec(config: OverUnderConfig, seed: int, rng: np.random.Generator) -> WorldSpec:
    """Builds the hall of `config`."""
    plan = config.plan
    ends = blocks.start_and_goal(plan, rng)
    half = config.width / 2
    first = int(rng.integers(2))
    barriers = []
    step = (config.length - 2 * blocks.INSET) / (config.barriers + 1)
    for k in range(config.barriers):
        x = blocks.INSET + step * (k + 1 + rng.uniform(-0.08, 0.08))
        low, high = (0.0, config.over) if (k + first) % 2 else (config.under, config.height)
        corners = (x - blocks.WALL / 2, -half, low), (x + blocks.WALL / 2, half, high)
        barriers.append(blocks.box(*corners, *blocks.draw_paint(_MATERIALS, rng)))
    sides = blocks.hall(plan, ["plaster", "brick", "concrete", "metal"], rng)
    signs = [s for wall in barriers for s in blocks.signs_on(wall, 0, 2, rng)]
    signs += blocks.signs_in(sides, 3, 0, rng)
    floor = blocks.ground(("tiles", "concrete")[rng.integers(2)], int(rng.integers(10)))
    solids = [floor, blocks.roof(plan), *sides, *barriers, *signs]
    return blocks.volume_spec("over_under", config, seed, solids, ends, blocks.lamplight(plan, rng))
