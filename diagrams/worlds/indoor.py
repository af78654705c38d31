"""Furnished worlds: a room, and the floor of an office."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RotationMatrix

from splatpilot.diagrams.worlds import building_blocks as blocks
from splatpilot.diagrams.worlds.feasibility import CLEARANCE, until_feasible
from splatpilot.diagrams.worlds.solids.solid import Solid, WorldSpec
from splatpilot.systems.collision.shapes import Capsule, Cylinder, Sphere
from splatpilot.systems.common.validation import bounded, require_field


def furnish(
    items: int,
    lower: NDArray,
    upper: NDArray,
    height: float,
    free: list[NDArray],
    rng: np.random.Generator,
) -> list[Solid]:
    """Draws furniture with centers in [lower, upper] (2,) of a room of a height [m], none within
    `CLEARANCE` of `free` points (3,) [m]; pieces that do not fit in 50 draws are left out."""
    furniture: list[Solid] = []
    for _ in range(items):
        make = FURNITURE[rng.integers(len(FURNITURE))]
        for _ in range(50):
            p = rng.uniform(lower, upper)
            angle = rng.choice(4) * np.pi / 2 + rng.normal(0, 0.12)
            item = make(p, angle, height, int(rng.integers(1000)), rng)
            if all(blocks.has_clearance(solid.shape, free, CLEARANCE) for solid in item):
                furniture += item
                break
    return furniture


def _parts(p: NDArray, angle: float, parts: list[tuple], seed: int) -> list[Solid]:
    """Builds boxes from (center (3,), size (3,), material) in the frame of a piece at p (2,)."""
    R = RotationMatrix.MakeZRotation(angle)
    at = np.array([*p, 0.0])
    return [
        blocks.rotated_box(at + R.multiply(np.array(center, float)), R, size, material, seed)
        for center, size, material in parts
    ]


# Each `Item` builds a piece of furniture at p (2,) [m], rotated by `angle` [rad] about z, in a room
# of a height [m]; the seed is of its appearance, the random numbers of its size.
type Item = Callable[[NDArray, float, float, int, np.random.Generator], list[Solid]]


def _shelf(p, angle, height, seed, rng) -> list[Solid]:
    w, d, h = rng.uniform(1.2, 2.0), 0.4, rng.uniform(1.6, min(2.4, height - 0.2))
    boards = [((0, 0, z), (w, d, 0.05), "wood") for z in np.linspace(0.1, h - 0.03, 5)]
    sides = [((x, 0, h / 2), (0.05, d, h), "wood") for x in (-w / 2, w / 2)]
    boxes = []
    for z in np.linspace(0.1, h - 0.03, 5)[:4]:
        s, x = rng.uniform(0.12, 0.25), rng.uniform(-0.4, 0.4) * w
        boxes.append(((x, 0, z + 0.02 + s / 2), (rng.uniform(0.3, 0.6), 0.3, s), "crate"))
    return _parts(p, angle, [*boards, *sides, *boxes], seed)


def _cabinet(p, angle, height, seed, rng) -> list[Solid]:
    w, d, h = rng.uniform(0.6, 1.2), rng.uniform(0.45, 0.7), rng.uniform(1.0, 2.0)
    return _parts(p, angle, [((0, 0, h / 2), (w, d, h), ("metal", "wood")[seed % 2])], seed)


def _table(p, angle, height, seed, rng) -> list[Solid]:
    w, d, h = rng.uniform(1.1, 1.8), rng.uniform(0.7, 1.0), 0.75
    legs = [
        ((x * (w / 2 - 0.06), y * (d / 2 - 0.06), h / 2), (0.06, 0.06, h), "wood")
        for x in (-1, 1)
        for y in (-1, 1)
    ]
    return _parts(p, angle, [((0, 0, h), (w, d, 0.05), "wood"), *legs], seed)


def _sofa(p, angle, height, seed, rng) -> list[Solid]:
    w = rng.uniform(1.4, 2.2)
    parts = [
        ((0, 0, 0.22), (w, 0.85, 0.44), "fabric"),
        ((0, -0.35, 0.5), (w, 0.2, 0.75), "fabric"),
        *(((x * (w / 2 - 0.1), 0, 0.33), (0.2, 0.85, 0.6), "fabric") for x in (-1, 1)),
    ]
    return _parts(p, angle, parts, seed)


def _crates(p, angle, height, seed, rng) -> list[Solid]:
    sizes = rng.uniform(0.45, 0.8, int(rng.integers(1, 4)))
    tops = np.cumsum(sizes)
    parts = [((0, 0, t - s / 2), (s, s, s), "crate") for s, t in zip(sizes, tops, strict=True)]
    return _parts(p, angle, [p for p, t in zip(parts, tops, strict=True) if t < height], seed)


def _column(p, angle, height, seed, rng) -> list[Solid]:
    foot, head = np.array([*p, -0.1]), np.array([*p, height + 0.1])
    material = ("concrete", "brick", "hazard")[seed % 3]
    return [Solid(Cylinder(foot, head, float(rng.uniform(0.15, 0.3))), material, seed)]


def _lamp(p, angle, height, seed, rng) -> list[Solid]:
    z = rng.uniform(1.5, 2.3)
    head, shade = np.array([*p, height]), np.array([*p, z])
    return [
        Solid(Capsule(shade, head, 0.012), "cable", seed),
        Solid(Sphere(shade, float(rng.uniform(0.15, 0.28))), ("fabric", "metal")[seed % 2], seed),
    ]


def _plant(p, angle, height, seed, rng) -> list[Solid]:
    foot, rim = np.array([*p, 0.0]), np.array([*p, 0.45])
    top = np.array([*p, rng.uniform(0.9, 1.4)])
    return [
        Solid(Cylinder(foot, rim, 0.2), "brick", seed),
        Solid(Capsule(rim, top, 0.03), "oak", seed),
        Solid(Sphere(top, float(rng.uniform(0.3, 0.45))), "foliage", seed),
    ]


FURNITURE: tuple[Item, ...] = (_shelf, _cabinet, _table, _sofa, _crates, _column, _lamp, _plant)


@dataclass
class RoomConfig(blocks.VolumeConfig):
    """A room with furniture."""

    length: float = bounded(12.0, "[6, 200] m")  # [m] along x: from 0 to length
    width: float = bounded(10.0, "[4, 200] m")  # [m] along y, centered on 0
    height: float = bounded(3.2, "[2.4, 100] m")  # [m] along z
    items: int = bounded(16, "[0, 1000]")  # [-] pieces of furniture
    voxel_size: float = bounded(0.1, "(0, 200] m")  # [m] of the distance grid


@until_feasible
def room_spec(config: RoomConfig, seed: int, rng: np.random.Generator) -> WorldSpec:
    """Furnishes the room of `config`."""
    plan = config.plan
    ends = blocks.start_and_goal(plan, rng, (1.0, min(1.9, config.height - 0.9)))
    inner = plan.lower[:2] + 0.7, plan.upper[:2] - 0.7
    furniture = furnish(config.items, *inner, config.height, list(ends), rng)
    sides = blocks.hall(plan, ["plaster", "plaster", "wood", "brick"], rng)
    signs = blocks.signs_in(sides, 2, 2, rng)
    floor = blocks.ground(("tiles", "wood", "concrete")[rng.integers(3)], int(rng.integers(10)))
    solids = [floor, blocks.roof(plan), *sides, *signs, *furniture]
    return blocks.volume_spec("room", config, seed, solids, ends, blocks.lamplight(plan, rng))


PARTITION = 0.15  # [m], thickness of the walls between rooms
JAMB = 0.25  # [m], minimum length of wall between a door and a corner


@dataclass
class OfficeConfig(blocks.VolumeConfig):
    """A floor divided into rooms, with start and goal in rooms at opposite ends. Walls divide it
    until no side is twice `room`. Every wall has one or two doors, so all rooms are connected."""

    length: float = bounded(22.0, "[6, 200] m")  # [m] along x: from 0 to length
    width: float = bounded(14.0, "[4, 200] m")  # [m] along y, centered on 0
    height: float = bounded(3.0, "[2.4, 100] m")  # [m] along z
    room: float = bounded(3.2, "(0, 200] m")  # [m] minimum side of a room
    door_min: float = bounded(1.0, f"[{blocks.PASSAGE:.3f}, 100] m")  # [m] minimum width of doors
    door_max: float = bounded(1.6, "(0, 100] m")  # [m] maximum width of doors
    # [m] Height of every other door; the rest reach the ceiling.
    door_height: float = bounded(2.1, f"[{blocks.PASSAGE:.3f}, 200] m")
    second_doors: float = bounded(0.3, "[0, 1]")  # [-] fraction of the walls that have two
    items: int = bounded(20, "[0, 1000]")  # [-] pieces of furniture
    voxel_size: float = bounded(0.1, "(0, 200] m")  # [m] of the distance grid

    def check(self) -> None:
        super().check()
        blocks.require_order(self, "door_min", "door_max")
        blocks.require_order(self, "door_height", "height")
        # For a door, a start or a goal.
        low = max(self.door_max + 2 * JAMB, 2 * CLEARANCE + PARTITION)
        high = min(self.length, self.width)
        require_field(self, "room", low <= self.room <= high, f"in [{low:g}, {high:g}] m")


class _Room(NamedTuple):
    """A rectangle of the floor between the middles of walls."""

    lower: NDArray  # (2,) [m]
    upper: NDArray  # (2,) [m]

    def inside(self, margin: float) -> tuple[NDArray, NDArray]:
        """Returns the corners (2,), `margin` [m] inwards."""
        return self.lower + margin, self.upper - margin


class _Door(NamedTuple):
    """A gap in a wall."""

    middle: float  # [m], along the wall
    width: float  # [m]
    height: float  # [m]


class _Partition(NamedTuple):
    """A wall between rooms, normal to an axis."""

    axis: int  # 0 for x, 1 for y
    at: float  # [m], its middle along the axis
    low: float  # [m], its ends along the other axis
    high: float
    doors: list[_Door]

    def point(self, across: float, along: float, z: float) -> NDArray:
        """Returns the point (3,) `across` [m] from the middle of the wall, at `along` and z [m]."""
        p = np.array([along, along, z])
        p[self.axis] = self.at + across
        return p


@until_feasible
def office_spec(config: OfficeConfig, seed: int, rng: np.random.Generator) -> WorldSpec:
    """Divides and furnishes the floor of `config`."""
    plan = config.plan
    partitions: list[_Partition] = []
    rooms = _divide(_Room(plan.lower[:2], plan.upper[:2]), config, partitions, rng)
    p_WS = _point_in([r for r in rooms if r.lower[0] == plan.lower[0]], config, rng)
    p_WG = _point_in([r for r in rooms if r.upper[0] == plan.upper[0]], config, rng)
    free = [p_WS, p_WG]
    free += [wall.point(0, door.middle, 1.1) for wall in partitions for door in wall.doors]
    areas = np.array([np.prod(room.upper - room.lower) for room in rooms])
    counts = rng.multinomial(config.items, areas / areas.sum())
    furniture: list[Solid] = []
    for room, items in zip(rooms, counts, strict=True):
        furniture += furnish(int(items), *room.inside(0.9), config.height, free, rng)
    sides = blocks.hall(plan, ["plaster", "plaster", "concrete"], rng)
    signs = blocks.signs_in(sides, 3, 2, rng)
    walls: list[Solid] = []
    for partition in partitions:
        pieces = _build(partition, config.height, rng)
        walls += pieces
        for piece in pieces:
            for face in (2 * partition.axis, 2 * partition.axis + 1):
                signs += blocks.signs_on(piece, face, int(rng.integers(2)), rng)
    floor = blocks.ground(("tiles", "wood", "concrete")[rng.integers(3)], int(rng.integers(10)))
    solids = [floor, blocks.roof(plan), *sides, *walls, *signs, *furniture]
    return blocks.volume_spec(
        "office", config, seed, solids, (p_WS, p_WG), blocks.lamplight(plan, rng)
    )


def _divide(
    whole: _Room, config: OfficeConfig, partitions: list[_Partition], rng: np.random.Generator
) -> list[_Room]:
    """Divides a rectangle into rooms by walls across its longer side; appends these."""
    axis = int(np.argmax(whole.upper - whole.lower))
    low, high = whole.inside(config.room)
    if high[axis] < low[axis]:
        return [whole]
    for at in rng.uniform(low[axis], high[axis], 20):
        if not any(_ends_in_door(wall, axis, at, whole) for wall in partitions):
            break
    else:
        return [whole]
    ends = whole.lower[1 - axis], whole.upper[1 - axis]
    doors = _doors(*ends, config, rng)
    partitions.append(_Partition(axis, at, *ends, doors))
    middle_low, middle_high = whole.lower.copy(), whole.upper.copy()
    middle_low[axis] = middle_high[axis] = at
    return [
        *_divide(_Room(whole.lower, middle_high), config, partitions, rng),
        *_divide(_Room(middle_low, whole.upper), config, partitions, rng),
    ]


def _ends_in_door(wall: _Partition, axis: int, at: float, whole: _Room) -> bool:
    """Checks if a new wall across `whole` would end at a door of another one."""
    bounds = whole.lower[wall.axis], whole.upper[wall.axis]
    return (
        wall.axis != axis
        and wall.at in bounds
        and any(abs(door.middle - at) < (door.width + PARTITION) / 2 + JAMB for door in wall.doors)
    )


def _doors(low: float, high: float, config: OfficeConfig, rng: np.random.Generator) -> list[_Door]:
    """Draws one door of a wall from `low` to `high` [m], or two in different halves of it."""
    two = rng.random() < config.second_doors and high - low >= 2 * (config.door_max + 2 * JAMB)
    stretches = [(low, (low + high) / 2), ((low + high) / 2, high)] if two else [(low, high)]
    doors = []
    for a, b in stretches:
        width = rng.uniform(config.door_min, config.door_max)
        height = (config.door_height, config.height)[rng.integers(2)]
        doors.append(_Door(rng.uniform(a + JAMB + width / 2, b - JAMB - width / 2), width, height))
    return doors


def _point_in(rooms: list[_Room], config: OfficeConfig, rng: np.random.Generator) -> NDArray:
    """Draws a start or goal (3,) [m] in one of the rooms."""
    corners = rooms[rng.integers(len(rooms))].inside(CLEARANCE + PARTITION / 2)
    return np.array([*rng.uniform(*corners), rng.uniform(1.0, min(1.9, config.height - 0.9))])


def _build(wall: _Partition, height: float, rng: np.random.Generator) -> list[Solid]:
    """Returns the pieces of a wall between its doors and above them, as boxes."""
    material = ("plaster", "plaster", "wood", "brick")[rng.integers(4)]
    seed, half = int(rng.integers(1000)), PARTITION / 2
    doors = [(door.middle - door.width / 2, door.middle + door.width / 2) for door in wall.doors]
    edges = [wall.low, *(edge for door in doors for edge in door), wall.high]
    pieces = [(a, b, 0.0) for a, b in zip(edges[::2], edges[1::2], strict=True)]
    tops = zip(doors, wall.doors, strict=True)
    pieces += [(*edges, door.height) for edges, door in tops if door.height < height]
    return [
        blocks.box(wall.point(-half, a, bottom), wall.point(half, b, height), material, seed)
        for a, b, bottom in pieces
    ]
