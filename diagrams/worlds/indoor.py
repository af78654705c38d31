"""A small furnished room."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RotationMatrix

from splatpilot.diagrams.worlds.building_blocks import (
    PASSAGE,
    box,
    check_count,
    check_ground,
    check_positive,
    check_range,
    check_size,
    clear_of,
    ground,
    hall,
    lamplight,
    roof,
    signs_in,
    signs_on,
    start_and_goal,
    turned_box,
)
from splatpilot.diagrams.worlds.feasibility import CLEARANCE, draw_feasible
from splatpilot.diagrams.worlds.solids.solid import Solid, WorldSpec
from splatpilot.diagrams.worlds.solids.surfaces import FloorPlan
from splatpilot.systems.collision.shapes import Capsule, Cylinder, Sphere


def furnish(
    items: int,
    lower: NDArray,
    upper: NDArray,
    height: float,
    free: list[NDArray],
    rng: np.random.Generator,
) -> list[Solid]:
    """
    Puts furniture into a room, none within `CLEARANCE` of what must stay free.

    Args:
        items: how many pieces; those for which 50 draws find no place are left out.
        lower, upper: (2,) [m], between which the middles of pieces are.
        height: [m], of the ceiling above the floor z = 0.
        free: points (3,) [m] to stay away from.
    """
    furniture: list[Solid] = []
    for _ in range(items):
        make = FURNITURE[rng.integers(len(FURNITURE))]
        for _ in range(50):
            place = rng.uniform(lower, upper)
            turn = rng.choice(4) * np.pi / 2 + rng.normal(0, 0.12)
            item = make(place, turn, height, int(rng.integers(1000)), rng)
            if all(clear_of(solid.shape, free, CLEARANCE) for solid in item):
                furniture += item
                break
    return furniture


type Item = Callable[[NDArray, float, float, int, np.random.Generator], list[Solid]]
"""Builds a piece of furniture from its place (2,) [m], its direction [rad], the height of the room
[m], a seed for its looks and random numbers for its measures."""


def _parts(place: NDArray, turn: float, parts: list[tuple], seed: int) -> list[Solid]:
    """Boxes (center (3,), size (3,), material) of a piece standing at `place`, turned about z."""
    R = RotationMatrix.MakeZRotation(turn)
    at = np.array([*place, 0.0])
    return [
        turned_box(at + R.multiply(np.array(center, float)), R, size, material, seed)
        for center, size, material in parts
    ]


def _shelf(place, turn, height, seed, rng) -> list[Solid]:
    w, d, h = rng.uniform(1.2, 2.0), 0.4, rng.uniform(1.6, min(2.4, height - 0.2))
    boards = [((0, 0, z), (w, d, 0.05), "wood") for z in np.linspace(0.1, h - 0.03, 5)]
    sides = [((x, 0, h / 2), (0.05, d, h), "wood") for x in (-w / 2, w / 2)]
    boxes = [
        (
            (rng.uniform(-0.4, 0.4) * w, 0, z + 0.02 + s / 2),
            (rng.uniform(0.3, 0.6), 0.3, s),
            "crate",
        )
        for z in np.linspace(0.1, h - 0.03, 5)[:4]
        for s in [rng.uniform(0.12, 0.25)]
    ]
    return _parts(place, turn, [*boards, *sides, *boxes], seed)


def _cabinet(place, turn, height, seed, rng) -> list[Solid]:
    w, d, h = rng.uniform(0.6, 1.2), rng.uniform(0.45, 0.7), rng.uniform(1.0, 2.0)
    return _parts(place, turn, [((0, 0, h / 2), (w, d, h), ("metal", "wood")[seed % 2])], seed)


def _table(place, turn, height, seed, rng) -> list[Solid]:
    w, d, h = rng.uniform(1.1, 1.8), rng.uniform(0.7, 1.0), 0.75
    legs = [
        ((x * (w / 2 - 0.06), y * (d / 2 - 0.06), h / 2), (0.06, 0.06, h), "wood")
        for x in (-1, 1)
        for y in (-1, 1)
    ]
    return _parts(place, turn, [((0, 0, h), (w, d, 0.05), "wood"), *legs], seed)


def _sofa(place, turn, height, seed, rng) -> list[Solid]:
    w = rng.uniform(1.4, 2.2)
    parts = [
        ((0, 0, 0.22), (w, 0.85, 0.44), "fabric"),
        ((0, -0.35, 0.5), (w, 0.2, 0.75), "fabric"),
        *(((x * (w / 2 - 0.1), 0, 0.33), (0.2, 0.85, 0.6), "fabric") for x in (-1, 1)),
    ]
    return _parts(place, turn, parts, seed)


def _crates(place, turn, height, seed, rng) -> list[Solid]:
    sizes = rng.uniform(0.45, 0.8, int(rng.integers(1, 4)))
    tops = np.cumsum(sizes)
    parts = [((0, 0, t - s / 2), (s, s, s), "crate") for s, t in zip(sizes, tops, strict=True)]
    return _parts(place, turn, [p for p, t in zip(parts, tops, strict=True) if t < height], seed)


def _column(place, turn, height, seed, rng) -> list[Solid]:
    foot, head = np.array([*place, -0.1]), np.array([*place, height + 0.1])
    material = ("concrete", "brick", "hazard")[seed % 3]
    return [Solid(Cylinder(foot, head, float(rng.uniform(0.15, 0.3))), material, seed)]


def _lamp(place, turn, height, seed, rng) -> list[Solid]:
    z = rng.uniform(1.5, 2.3)
    head, shade = np.array([*place, height]), np.array([*place, z])
    return [
        Solid(Capsule(shade, head, 0.012), "cable", seed),
        Solid(Sphere(shade, float(rng.uniform(0.15, 0.28))), ("fabric", "metal")[seed % 2], seed),
    ]


def _plant(place, turn, height, seed, rng) -> list[Solid]:
    foot, rim = np.array([*place, 0.0]), np.array([*place, 0.45])
    top = np.array([*place, rng.uniform(0.9, 1.4)])
    return [
        Solid(Cylinder(foot, rim, 0.2), "brick", seed),
        Solid(Capsule(rim, top, 0.03), "oak", seed),
        Solid(Sphere(top, float(rng.uniform(0.3, 0.45))), "foliage", seed),
    ]


FURNITURE: tuple[Item, ...] = (_shelf, _cabinet, _table, _sofa, _crates, _column, _lamp, _plant)


@dataclass
class RoomConfig:
    """A room with furniture, flown from end to end."""

    length: float = 12.0  # [m] along x: from 0 to length
    width: float = 10.0  # [m] along y, centred on 0
    height: float = 3.2  # [m] along z
    items: int = 16  # [-] pieces of furniture
    voxel_size: float = 0.1  # [m] of the distance grid

    def validate(self) -> None:
        """Raises ValueError for the first value with which no room can be furnished."""
        check_positive(self, "length", "width", "height", "voxel_size")
        check_ground(self)
        check_count(self, "items")
        check_size(self, "room", 6, 4, 2.4)


def room_spec(config: RoomConfig, seed: int) -> WorldSpec:
    """Furnishes the room of `config`.

    Raises:
        ValueError: for values with which none can be made, or without a way through.
    """
    config.validate()
    plan = FloorPlan.of_size(config.length, config.width, config.height)

    def draw(rng: np.random.Generator) -> WorldSpec:
        p_WS, p_WG = start_and_goal(plan, rng, (1.0, min(1.9, config.height - 0.9)))
        inner = plan.lower[:2] + 0.7, plan.upper[:2] - 0.7
        furniture = furnish(config.items, *inner, config.height, [p_WS, p_WG], rng)
        sides = hall(plan, ["plaster", "plaster", "wood", "brick"], rng)
        signs = signs_in(sides, 2, 2, rng)
        floor = ground(("tiles", "wood", "concrete")[rng.integers(3)], int(rng.integers(10)))
        return WorldSpec(
            name="room",
            lower_W=plan.lower,
            upper_W=plan.upper,
            solids=[floor, roof(plan), *sides, *signs, *furniture],
            p_WS=p_WS,
            p_WG=p_WG,
            light=lamplight(plan, rng),
            seed=seed,
            voxel_size=config.voxel_size,
        )

    return draw_feasible(draw, seed)


PARTITION = 0.15
"""[m], thickness of the walls between rooms."""

JAMB = 0.25
"""[m], least length of wall between a door and a corner."""


@dataclass
class OfficeConfig:
    """A floor divided into rooms, flown from a room at one end to a room at the other.

    Walls divide it, and what is left, until no side is twice `room`. Every wall has a door, so all
    rooms are connected; some have two, so that there are ways around.
    """

    length: float = 22.0  # [m] along x: from 0 to length
    width: float = 14.0  # [m] along y, centred on 0
    height: float = 3.0  # [m] along z
    room: float = 3.2  # [m] least side of a room
    door_min: float = 1.0  # [m] width of doors: least
    door_max: float = 1.6  # [m] and most
    door_height: float = 2.1  # [m] of every other door; the rest reach the ceiling
    second_doors: float = 0.3  # [-] part of the walls that have two
    items: int = 20  # [-] pieces of furniture
    voxel_size: float = 0.1  # [m] of the distance grid

    def validate(self) -> None:
        """Raises ValueError for the first value with which no floor can be divided."""
        check_positive(self, "length", "width", "height", "room", "door_height", "voxel_size")
        check_ground(self)
        check_count(self, "items")
        check_range(self, "door_min", "door_max")
        check_size(self, "floor", 6, 4, 2.4)
        if self.door_min < PASSAGE:
            raise ValueError(
                f"door_min = {self.door_min} m must be at least {PASSAGE:.2f} m, for the vehicle"
            )
        if not PASSAGE <= self.door_height <= self.height:
            raise ValueError(
                f"door_height = {self.door_height} m must be {PASSAGE:.2f} m, for the vehicle, to "
                f"height = {self.height:g} m"
            )
        least = max(self.door_max + 2 * JAMB, 2 * CLEARANCE + PARTITION)
        if not least <= self.room <= min(self.length, self.width):
            raise ValueError(
                f"room = {self.room} m must be {least:g} m, for a door, a start or a goal, to "
                f"{min(self.length, self.width):g} m, the floor's lesser side"
            )
        if not 0 <= self.second_doors <= 1:
            raise ValueError(f"second_doors = {self.second_doors} must be 0 to 1")


class _Room(NamedTuple):
    """A rectangle of the floor between the middles of walls."""

    lower: NDArray  # (2,) [m]
    upper: NDArray  # (2,) [m]

    def inside(self, margin: float) -> tuple[NDArray, NDArray]:
        """Its corners (2,), `margin` [m] inwards."""
        return self.lower + margin, self.upper - margin


class _Door(NamedTuple):
    """A gap in a wall."""

    middle: float  # [m], along the wall
    width: float  # [m]
    height: float  # [m]


class _Partition(NamedTuple):
    """A wall between rooms, its middle at `at` [m] along an axis, across which it stands."""

    axis: int  # 0 for x, 1 for y
    at: float
    low: float  # [m], where it begins and ends along the other axis
    high: float
    doors: list[_Door]

    def point(self, across: float, along: float, z: float) -> NDArray:
        """The point (3,) `across` [m] from the middle of the wall and at `along` and z [m]."""
        p = np.array([along, along, z])
        p[self.axis] = self.at + across
        return p


def office_spec(config: OfficeConfig, seed: int) -> WorldSpec:
    """Divides and furnishes the floor of `config`.

    Raises:
        ValueError: for values with which none can be made, or without a way through.
    """
    config.validate()
    plan = FloorPlan.of_size(config.length, config.width, config.height)

    def draw(rng: np.random.Generator) -> WorldSpec:
        partitions: list[_Partition] = []
        rooms = _divide(_Room(plan.lower[:2], plan.upper[:2]), config, partitions, rng)
        p_WS = _place_in([r for r in rooms if r.lower[0] == plan.lower[0]], config, rng)
        p_WG = _place_in([r for r in rooms if r.upper[0] == plan.upper[0]], config, rng)
        free = [p_WS, p_WG]
        free += [wall.point(0, door.middle, 1.1) for wall in partitions for door in wall.doors]
        areas = np.array([np.prod(room.upper - room.lower) for room in rooms])
        furniture: list[Solid] = []
        for room, items in zip(
            rooms, rng.multinomial(config.items, areas / areas.sum()), strict=True
        ):
            furniture += furnish(int(items), *room.inside(0.9), config.height, free, rng)
        sides = hall(plan, ["plaster", "plaster", "concrete"], rng)
        signs = signs_in(sides, 3, 2, rng)
        walls: list[Solid] = []
        for partition in partitions:
            pieces = _build(partition, config.height, rng)
            walls += pieces
            for piece in pieces:
                for face in (2 * partition.axis, 2 * partition.axis + 1):
                    signs += signs_on(piece, face, int(rng.integers(2)), rng)
        floor = ground(("tiles", "wood", "concrete")[rng.integers(3)], int(rng.integers(10)))
        return WorldSpec(
            name="office",
            lower_W=plan.lower,
            upper_W=plan.upper,
            solids=[floor, roof(plan), *sides, *walls, *signs, *furniture],
            p_WS=p_WS,
            p_WG=p_WG,
            light=lamplight(plan, rng),
            seed=seed,
            voxel_size=config.voxel_size,
        )

    return draw_feasible(draw, seed)


def _divide(
    whole: _Room, config: OfficeConfig, partitions: list[_Partition], rng: np.random.Generator
) -> list[_Room]:
    """Divides a rectangle into rooms by walls across its longer side, which it appends."""
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
    """Whether a new wall across `whole` would end in, or at, a door of another one."""
    bounds = whole.lower[wall.axis], whole.upper[wall.axis]
    return (
        wall.axis != axis
        and wall.at in bounds
        and any(abs(door.middle - at) < (door.width + PARTITION) / 2 + JAMB for door in wall.doors)
    )


def _doors(low: float, high: float, config: OfficeConfig, rng: np.random.Generator) -> list[_Door]:
    """One door or two of a wall from `low` to `high` [m], two in different halves of it."""
    least = config.door_max + 2 * JAMB
    two = rng.random() < config.second_doors and high - low >= 2 * least
    stretches = [(low, (low + high) / 2), ((low + high) / 2, high)] if two else [(low, high)]
    doors = []
    for a, b in stretches:
        width = rng.uniform(config.door_min, config.door_max)
        height = (config.door_height, config.height)[rng.integers(2)]
        doors.append(_Door(rng.uniform(a + JAMB + width / 2, b - JAMB - width / 2), width, height))
    return doors


def _place_in(rooms: list[_Room], config: OfficeConfig, rng: np.random.Generator) -> NDArray:
    """A start or goal (3,) [m] in one of the rooms."""
    corners = rooms[rng.integers(len(rooms))].inside(CLEARANCE + PARTITION / 2)
    return np.array([*rng.uniform(*corners), rng.uniform(1.0, min(1.9, config.height - 0.9))])


def _build(wall: _Partition, height: float, rng: np.random.Generator) -> list[Solid]:
    """The pieces of a wall between its doors and above them, as boxes."""
    material = ("plaster", "plaster", "wood", "brick")[rng.integers(4)]
    seed, half = int(rng.integers(1000)), PARTITION / 2
    edges = [wall.low]
    for door in wall.doors:
        edges += [door.middle - door.width / 2, door.middle + door.width / 2]
    edges.append(wall.high)
    pieces = [(a, b, 0.0) for a, b in zip(edges[::2], edges[1::2], strict=True)]
    pieces += [
        (door.middle - door.width / 2, door.middle + door.width / 2, door.height)
        for door in wall.doors
        if door.height < height
    ]
    return [
        box(wall.point(-half, a, bottom), wall.point(half, b, height), material, seed)
        for a, b, bottom in pieces
    ]
