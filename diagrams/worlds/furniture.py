"""Furniture: what stands in rooms and hangs from their ceilings."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RotationMatrix

from splatpilot.diagrams.worlds.feasibility import CLEARANCE
from splatpilot.diagrams.worlds.fittings import clear_of, turned_box
from splatpilot.diagrams.worlds.solids.solid import Solid
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
