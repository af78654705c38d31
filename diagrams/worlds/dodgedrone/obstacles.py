"""The obstacles of the DodgeDrone challenge, number for number as its generator draws them."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
type Triple = tuple[float, float, float]

SEED = 20220301
"""Of the generator, as it was published."""

PERIOD = 0.02
"""[s] between the rows of a path."""

_ROWS = 1500
"""Rows of a path that never leaves its region: 30 s."""

_KEPT_FREE = ((-3.0, -3.0, 0.0), (3.0, 3.0, 5.0)), ((57.0, -3.0, 0.0), (61.0, 3.0, 5.0))
"""[m] Corners of the boxes about start and target; an obstacle is nowhere while its centre is in
one of them."""


@dataclass(frozen=True)
class Group:
    """Obstacles that are drawn alike."""

    count: int
    lower: Triple  # [m], corners of the region of their centres
    upper: Triple
    diameters: tuple[float, float]  # [m], least and largest
    speed: Triple = (0.0, 0.0, 0.0)  # [m/s], largest along each axis at first; zero: they stand
    acceleration: float = 0.0  # [m/s^2], largest along each axis, another one every row


@dataclass(frozen=True, eq=False)
class Obstacle:
    """A ball, and where it goes."""

    radius: float  # [m]
    path: Array  # (rows, 3) [m], one row if it stands; infinite where it is nowhere


_ALL = (0.0, -10.0, 0.0), (60.0, 10.0, 10.0)
_FROM_20 = (20.0, -10.0, 0.0), (60.0, 10.0, 10.0)
_FROM_40 = (40.0, -10.0, 0.0), (60.0, 10.0, 10.0)
_ANY, _MIDDLE, _SMALL = (0.1, 3.0), (0.5, 2.0), (0.5, 1.5)

LEVELS: dict[str, tuple[Group, ...]] = {
    "easy": (
        Group(76, *_ALL, _ANY),
        Group(9, *_FROM_20, _MIDDLE, (5.0, 5.0, 2.0)),
    ),
    "medium": (
        Group(384, *_ALL, _ANY),
        Group(88, *_FROM_20, _MIDDLE, (1.0, 1.0, 1.0)),
        Group(84, *_FROM_40, _ANY),
        Group(44, *_FROM_40, _SMALL, (1.0, 1.0, 1.0), 5.0),
    ),
    "hard": (
        Group(246, (0.0, -10.0, 0.0), (30.0, 10.0, 10.0), _ANY),
        Group(132, *_ALL, _ANY),
        Group(328, *_FROM_20, _MIDDLE, (3.0, 3.0, 2.0)),
        Group(50, (40.0, -4.0, 0.0), (60.0, 4.0, 10.0), _SMALL, (1.0, 1.0, 1.0), 10.0),
    ),
}
"""The challenge's levels: medium as in its published configuration, easy and hard as in the lists
of obstacles that came with it."""


def draw_obstacles(groups: tuple[Group, ...], seed: int) -> list[Obstacle]:
    """Draws the obstacles of all groups in order; the same seed, the same bits."""
    rng = np.random.RandomState(seed)
    return [_draw(group, rng) for group in groups for _ in range(group.count)]


def _draw(group: Group, rng: np.random.RandomState) -> Obstacle:
    moves, accelerates = any(group.speed), group.acceleration > 0
    rows, speed = _ROWS if moves else 1, np.array(group.speed)
    lower, upper = np.array(group.lower), np.array(group.upper)
    diameter = rng.uniform(*group.diameters)
    acceleration = np.zeros((rows, 3))
    if accelerates:
        acceleration = rng.rand(rows, 3) * 2 * group.acceleration - group.acceleration
        rng.rand(3)  # body rates
    velocity = np.zeros(3)
    if moves:
        velocity = rng.rand(3) * 2 * speed - speed
    rng.rand(3)  # attitude
    place = rng.rand(3) * (upper - lower) + lower
    velocities = velocity + np.cumsum(acceleration, axis=0) * PERIOD
    path = place + np.cumsum(velocities, axis=0) * PERIOD
    # It ends where it leaves the region.
    outside = ((path > upper) | (path < lower)).any(axis=1)
    if outside.any():
        path = path[: max(1, int(np.argmax(outside)))]
    for low, high in _KEPT_FREE:
        path[((path > low) & (path < high)).all(axis=1)] = np.inf
    return Obstacle(diameter / 2, path)
