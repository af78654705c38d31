"""Spheres and boxes strewn over a field or floating in the air."""

from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RollPitchYaw, RotationMatrix
from scipy.spatial.transform import Rotation

from splatpilot.diagrams.worlds.building_blocks import (
    CLEARING,
    INSET,
    PASSAGE,
    TIGHT_CLEARING,
    WALL,
    box,
    check_count,
    check_ground,
    check_positive,
    check_range,
    check_size,
    clear_of,
    daylight,
    ground,
    hall,
    lamplight,
    roof,
    signs_in,
    signs_on,
    start_and_goal,
    turned_box,
)
from splatpilot.diagrams.worlds.feasibility import TRIES, draw_feasible, is_feasible
from splatpilot.diagrams.worlds.forest.forest import Forest
from splatpilot.diagrams.worlds.forest.layout import BARK, TrunksConfig
from splatpilot.diagrams.worlds.forest.scenery import trees_around
from splatpilot.diagrams.worlds.solids.shading import Illumination
from splatpilot.diagrams.worlds.solids.solid import Solid, WorldSpec
from splatpilot.diagrams.worlds.solids.surfaces import FloorPlan, merge
from splatpilot.diagrams.worlds.solids.surfels import draw
from splatpilot.systems.collision.shapes import Capsule, Sphere
from splatpilot.systems.common.provenance import InfeasibleFlightError
from splatpilot.systems.splats.scene import GaussianScene

_BALLS = ["stone", "concrete", "foliage", "hazard", "metal"]
_BOXES = ["crate", "wood", "metal", "hazard", "brick", "concrete", "signage", "fabric"]


@dataclass
class ClutterConfig:
    """An open field with spheres and boxes: upright pillars, or floating boxes turned anyhow."""

    length: float = 36.0  # [m] flyable volume along x: from 0 to length
    width: float = 20.0  # [m] along y, centred on 0
    height: float = 6.0  # [m] along z
    spheres: int = 10  # [-] spheres
    sphere_min: float = 0.6  # [m] smallest radius
    sphere_max: float = 1.8  # [m] largest radius
    boxes: int = 20  # [-] boxes
    half_min: float = 0.3  # [m] smallest half edge of a box
    half_max: float = 0.9  # [m] largest half edge
    # Whether boxes float, turned anyhow. Otherwise they are pillars on the ground, 2 m high at
    # least, that lean up to `lean_max`.
    floating: bool = False
    lean_max: float = 15.0  # [deg] largest tilt of a pillar
    voxel_size: float = 0.15  # [m] of the distance grid

    def validate(self) -> None:
        """Raises ValueError for the first value with which no field can be made."""
        check_positive(self, "length", "width", "height", "voxel_size")
        check_ground(self)
        check_range(self, "sphere_min", "sphere_max")
        check_range(self, "half_min", "half_max")
        check_count(self, "spheres", "boxes")
        if not 0 <= self.lean_max <= 45:
            raise ValueError(f"lean_max = {self.lean_max} deg must be 0 to 45 deg")
        check_size(self, "field", 6, 4, 3)


def clutter_spec(config: ClutterConfig, seed: int) -> WorldSpec:
    """Strews the field of `config`: obstacles anywhere but near start and goal, overlapping or not.

    Raises:
        ValueError: for values with which none can be made, or without a way through.
    """
    config.validate()
    plan = FloorPlan.of_size(config.length, config.width, config.height)

    def draw(rng: np.random.Generator) -> WorldSpec:
        p_WS, p_WG = start_and_goal(plan, rng)
        obstacles: list[Solid] = []
        for make, number in ((_sphere, config.spheres), (_box, config.boxes)):
            for _ in range(number):
                for _ in range(50):  # elsewhere, if it is too near the start or goal
                    solid = make(config, plan, rng)
                    if clear_of(solid.shape, [p_WS, p_WG], CLEARING):
                        obstacles.append(solid)
                        break
        hour, light = daylight(rng)
        return WorldSpec(
            name="clutter",
            lower_W=plan.lower,
            upper_W=plan.upper,
            solids=[ground(("grass", "paving", "concrete")[rng.integers(3)]), *obstacles],
            p_WS=p_WS,
            p_WG=p_WG,
            light=light,
            surroundings=trees_around(plan, hour, seed),
            seed=seed,
            voxel_size=config.voxel_size,
        )

    return draw_feasible(draw, seed)


def _sphere(config: ClutterConfig, plan: FloorPlan, rng: np.random.Generator) -> Solid:
    radius = rng.uniform(config.sphere_min, config.sphere_max)
    p = rng.uniform(plan.lower, plan.upper)
    material = _BALLS[rng.integers(len(_BALLS))]
    return Solid(Sphere(p, float(radius)), material, int(rng.integers(1000)))


def _box(config: ClutterConfig, plan: FloorPlan, rng: np.random.Generator) -> Solid:
    half = rng.uniform(config.half_min, config.half_max, 3)
    p = rng.uniform(plan.lower, plan.upper)
    if config.floating:
        turn = RotationMatrix(Rotation.random(rng=rng).as_matrix())
    else:
        lean = np.deg2rad(config.lean_max) * np.sqrt(rng.uniform())
        way = rng.uniform(0, 2 * np.pi)
        turn = RotationMatrix(
            RollPitchYaw(lean * np.cos(way), lean * np.sin(way), rng.uniform(0, np.pi))
        )
        top = rng.uniform(2.0, max(config.height, 2.5))
        half[2] = top / 2 + 0.3
        p[2] = top / 2 - 0.3
    material = _BOXES[rng.integers(len(_BOXES))]
    return turned_box(p, turn, 2 * half, material, int(rng.integers(1000)))


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


def branches_spec(config: BranchesConfig, seed: int) -> WorldSpec:
    """Grows the forest of `config` and puts limbs and wires into it.

    Raises:
        ValueError: see `forest_spec`.
        InfeasibleFlightError: if limbs and wires leave no route.
    """
    forest = Forest(config, seed)
    bare = forest.spec()
    for attempt in range(TRIES):
        thin = _limbs_and_wires(forest, config, np.random.default_rng([seed, 20, attempt]))
        spec = replace(bare, name="branches", solids=[*bare.solids, *thin])
        if is_feasible(spec):
            return replace(spec, gaussians=partial(_gaussians, forest, spec, thin))
    raise InfeasibleFlightError(
        f"branches: limbs = {config.limbs} and wires = {config.wires} leave no route in {TRIES} "
        f"draws from seed {seed}; use fewer of them or a wider spacing"
    )


def _gaussians(
    forest: Forest, spec: WorldSpec, thin: list[Solid], light: Illumination
) -> GaussianScene:
    return merge([forest.gaussians(), draw(spec, thin, light)])


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


PATTERNS = "big_wall", "u_trap", "slits", "slalom"

_FACADES = ["brick", "brick", "concrete", "metal", "wood", "plaster"]
_ACROSS = ["brick", "concrete", "metal", "wood", "foliage"]


@dataclass
class WallsConfig:
    """A roofless hall with walls as high as itself in the way."""

    # What stands across: one of big_wall, u_trap, slits, slalom.
    pattern: str = "slalom"
    length: float = 36.0  # [m] flyable volume along x: from 0 to length
    width: float = 14.0  # [m] along y, centred on 0
    height: float = 6.0  # [m] along z
    # [m] of the wall across: all of big_wall, the back of u_trap, each wall of slalom.
    wall: float = 10.4
    depth: float = 6.0  # [m] of the cul-de-sac of u_trap
    walls: int = 4  # [-] walls of slalom, from one side and the other in turn
    # [m] width of the slit in each wall of slits, in the order in which they are met.
    slits: list[float] = field(default_factory=lambda: [1.4, 1.25, 1.1, 1.0])
    voxel_size: float = 0.15  # [m] of the distance grid

    def validate(self) -> None:
        """Raises ValueError for the first value with which no hall can be built."""
        if self.pattern not in PATTERNS:
            raise ValueError(f"pattern = {self.pattern!r} must be one of {', '.join(PATTERNS)}")
        check_positive(self, "length", "width", "height", "wall", "depth", "voxel_size")
        check_ground(self)
        if self.pattern == "slits":
            for slit in self.slits:
                if not PASSAGE <= slit <= self.width / 2:
                    raise ValueError(
                        f"slits = {self.slits} m: each must be {PASSAGE:.2f} m, for the vehicle, "
                        f"to half the width, {self.width / 2:g} m"
                    )
        elif self.wall > self.width - PASSAGE:
            raise ValueError(
                f"wall = {self.wall} m must be at most width - {PASSAGE:.2f} m = "
                f"{self.width - PASSAGE:.2f} m, or it closes the hall"
            )
        if not 1 <= self.walls <= 20:
            raise ValueError(f"walls = {self.walls} must be 1 to 20")
        crossed = {"slits": len(self.slits), "slalom": self.walls}.get(self.pattern, 1)
        least = 2 * INSET + 2.0 * (crossed + 1) + (self.depth if self.pattern == "u_trap" else 0)
        if self.length < least:
            raise ValueError(
                f"length = {self.length} m must be at least {least:g} m for what stands across"
            )


def walls_spec(config: WallsConfig, seed: int) -> WorldSpec:
    """Builds the hall of `config`.

    `big_wall` leaves a way at either side of one wall, one of them wider; `u_trap` opens a
    cul-de-sac towards the start; the walls of `slits` have one slit each, well aside of the last;
    those of `slalom` leave a way at one side and the other in turn.

    Raises:
        ValueError: for values with which none can be built, or without a way through.
    """
    config.validate()
    plan = FloorPlan.of_size(config.length, config.width, config.height)

    def draw(rng: np.random.Generator) -> WorldSpec:
        p_WS, p_WG = start_and_goal(plan, rng)
        across = {"big_wall": _big_wall, "u_trap": _u_trap, "slits": _slits, "slalom": _slalom}
        if config.pattern in ("big_wall", "u_trap"):  # both stand in the straight way
            p_WS[1], p_WG[1] = 0.3 * p_WS[1], 0.3 * p_WG[1]
        obstacles = across[config.pattern](config, rng)
        sides = hall(plan, _FACADES, rng)
        signs = signs_in(sides, 3, 1, rng)
        for wall in obstacles:
            signs += signs_on(wall, 0, 1, rng)
        hour, light = daylight(rng)
        floor = ("paving", "grass", "concrete")[rng.integers(3)]
        return WorldSpec(
            name=config.pattern,
            lower_W=plan.lower,
            upper_W=plan.upper,
            solids=[ground(floor), *sides, *obstacles, *signs],
            p_WS=p_WS,
            p_WG=p_WG,
            light=light,
            surroundings=trees_around(plan, hour, seed),
            seed=seed,
            voxel_size=config.voxel_size,
        )

    return draw_feasible(draw, seed)


def _across(config: WallsConfig, x: float, y0: float, y1: float, material: str, seed: int) -> Solid:
    """A wall across the hall, its middle at x, from y0 to y1 [m]."""
    return box((x - WALL / 2, y0, 0), (x + WALL / 2, y1, config.height), material, seed)


def _material(rng: np.random.Generator) -> tuple[str, int]:
    return _ACROSS[rng.integers(len(_ACROSS))], int(rng.integers(1000))


def _big_wall(config: WallsConfig, rng: np.random.Generator) -> list[Solid]:
    spare = (config.width - config.wall) / 2  # [m] at either side of a wall in the middle
    x = rng.uniform(0.42, 0.58) * config.length
    y = rng.choice([-1, 1]) * rng.uniform(0.3, 0.7) * spare
    return [_across(config, x, y - config.wall / 2, y + config.wall / 2, *_material(rng))]


def _u_trap(config: WallsConfig, rng: np.random.Generator) -> list[Solid]:
    spare = (config.width - config.wall) / 2
    x = rng.uniform(0.58, 0.66) * config.length
    y = rng.uniform(-0.4, 0.4) * spare
    low, high = y - config.wall / 2, y + config.wall / 2
    material, seed = _material(rng)
    return [
        _across(config, x, low, high, material, seed),
        *(
            box((x - config.depth, a, 0), (x - WALL / 2, a + WALL, config.height), material, seed)
            for a in (low, high - WALL)
        ),
    ]


def _stations(config: WallsConfig, number: int, rng: np.random.Generator) -> NDArray:
    """Places (number,) [m] along x, about evenly between start and goal."""
    step = (config.length - 2 * INSET) / (number + 1)
    return INSET + step * (np.arange(1, number + 1) + rng.uniform(-0.1, 0.1, number))


def _slits(config: WallsConfig, rng: np.random.Generator) -> list[Solid]:
    half = config.width / 2
    walls, last = [], rng.uniform(-half, half)
    for x, slit in zip(_stations(config, len(config.slits), rng), config.slits, strict=True):
        room = half - slit / 2 - 0.5
        draws = rng.uniform(-room, room, 50)
        y = draws[np.argmax(np.abs(draws - last) > 0.25 * config.width)]
        material, seed = _material(rng)
        walls += [
            _across(config, x, -half, y - slit / 2, material, seed),
            _across(config, x, y + slit / 2, half, material, seed),
        ]
        last = y
    return walls


def _slalom(config: WallsConfig, rng: np.random.Generator) -> list[Solid]:
    half, side = config.width / 2, int(rng.integers(2))
    walls = []
    for k, x in enumerate(_stations(config, config.walls, rng)):
        ends = (-half, config.wall - half) if (k + side) % 2 else (half - config.wall, half)
        walls.append(_across(config, x, *ends, *_material(rng)))
    return walls


_MATERIALS = ["brick", "concrete", "hazard", "wood", "metal"]


@dataclass
class OverUnderConfig:
    """A roofed hall; its barriers stand wall to wall."""

    length: float = 36.0  # [m] flyable volume along x: from 0 to length
    width: float = 16.0  # [m] along y, centred on 0
    height: float = 6.0  # [m] along z, from the floor to the roof
    barriers: int = 5  # [-] over and under in turn; which comes first is drawn
    over: float = 2.8  # [m] height of barriers that stand on the floor
    under: float = 1.9  # [m] height of the lower edge of barriers that hang from the roof
    voxel_size: float = 0.15  # [m] of the distance grid

    def validate(self) -> None:
        """Raises ValueError for the first value with which no hall can be built."""
        check_positive(self, "length", "width", "height", "over", "under", "voxel_size")
        check_ground(self)
        if self.over > self.height - PASSAGE:
            raise ValueError(
                f"over = {self.over} m must be at most height - {PASSAGE:.2f} m = "
                f"{self.height - PASSAGE:.2f} m, or nothing fits under the roof"
            )
        if not PASSAGE <= self.under < self.height:
            raise ValueError(
                f"under = {self.under} m must be {PASSAGE:.2f} m, for the vehicle, to below the "
                f"height, {self.height:g} m"
            )
        least = 2 * INSET + 2.5 * (self.barriers + 1)
        if not 1 <= self.barriers <= 50 or self.length < least:
            raise ValueError(
                f"barriers = {self.barriers} must be 1 to 50 and need a length of {least:g} m; it "
                f"is {self.length:g} m"
            )


def over_under_spec(config: OverUnderConfig, seed: int) -> WorldSpec:
    """Builds the hall of `config`.

    Raises:
        ValueError: for values with which none can be built, or without a way through.
    """
    config.validate()
    plan = FloorPlan.of_size(config.length, config.width, config.height)

    def draw(rng: np.random.Generator) -> WorldSpec:
        p_WS, p_WG = start_and_goal(plan, rng)
        half, step = config.width / 2, (config.length - 2 * INSET) / (config.barriers + 1)
        first = int(rng.integers(2))
        barriers = []
        for k in range(config.barriers):
            x = INSET + step * (k + 1 + rng.uniform(-0.08, 0.08))
            low, high = (0.0, config.over) if (k + first) % 2 else (config.under, config.height)
            corners = (x - WALL / 2, -half, low), (x + WALL / 2, half, high)
            material = _MATERIALS[rng.integers(len(_MATERIALS))]
            barriers.append(box(*corners, material, int(rng.integers(1000))))
        sides = hall(plan, ["plaster", "brick", "concrete", "metal"], rng)
        signs = [s for wall in barriers for s in signs_on(wall, 0, 2, rng)]
        signs += signs_in(sides, 3, 0, rng)
        return WorldSpec(
            name="over_under",
            lower_W=plan.lower,
            upper_W=plan.upper,
            solids=[
                ground(("tiles", "concrete")[rng.integers(2)], int(rng.integers(10))),
                roof(plan),
                *sides,
                *barriers,
                *signs,
            ],
            p_WS=p_WS,
            p_WG=p_WG,
            light=lamplight(plan, rng),
            seed=seed,
            voxel_size=config.voxel_size,
        )

    return draw_feasible(draw, seed)
