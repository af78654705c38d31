"""What procedural worlds are put together from: boxes, halls, signs, daylight, lamps."""

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydrake.math import RigidTransform, RotationMatrix

from splatpilot.diagrams.worlds.solids.patterns import SIGN
from splatpilot.diagrams.worlds.solids.shading import Daylight, Illumination, Lamplight, Sunlight
from splatpilot.diagrams.worlds.solids.solid import Solid
from splatpilot.diagrams.worlds.solids.surfaces import FloorPlan
from splatpilot.systems.collision.esdf import Esdf
from splatpilot.systems.collision.occupancy import grid_shape
from splatpilot.systems.collision.shapes import Box, HalfSpace, Shape, ShapeUnion
from splatpilot.systems.vehicle.quadrotor import VEHICLE_RADIUS

WALL = 0.3
"""[m], thickness of walls."""

INSET = 1.5
"""[m], distance of start and goal from the ends of the volume."""

CLEARING, TIGHT_CLEARING = 1.0, 0.9
"""[m], radius about start and goal in which no obstacles are put: in the open, and among thin or
reconstructed things. It is more than the `CLEARANCE` that worlds are checked for."""

MAX_GROUND, MAX_HEIGHT = 20_000.0, 100.0
"""[m²] and [m], of generated worlds: 35 times the default forest, 20 million Gaussians."""

PASSAGE = 2 * VEHICLE_RADIUS + 0.1
"""[m], least width of a gap that is left for the vehicle."""


def box(lower: ArrayLike, upper: ArrayLike, material: str, seed: int) -> Solid:
    """An upright box between two corners (3,) [m]."""
    lower, upper = np.asarray(lower, float), np.asarray(upper, float)
    return Solid(Box(RigidTransform((lower + upper) / 2), upper - lower), material, seed)


def turned_box(p_W: ArrayLike, R_W: RotationMatrix, size: ArrayLike, material: str, seed: int):
    """A box about p_W (3,) [m] with edges `size` (3,) [m] along the axes of R_W."""
    return Solid(Box(RigidTransform(R_W, np.asarray(p_W, float)), size), material, seed)


def ground(material: str, seed: int = 0) -> Solid:
    """The ground z = 0."""
    return Solid(HalfSpace(np.array([0.0, 0.0, 1.0]), 0.0), material, seed)


def hall(plan: FloorPlan, materials: list[str], rng: np.random.Generator) -> list[Solid]:
    """The walls of a hall about its volume, each of one of the `materials`: its inner face is a
    bound of the volume; those at the least and greatest y first, then those at its two ends."""
    (x0, y0, _), (x1, y1, z1) = plan.lower, plan.upper
    sides = (
        ((x0 - WALL, y0 - WALL, 0), (x1 + WALL, y0, z1)),
        ((x0 - WALL, y1, 0), (x1 + WALL, y1 + WALL, z1)),
        ((x0 - WALL, y0, 0), (x0, y1, z1)),
        ((x1, y0, 0), (x1 + WALL, y1, z1)),
    )
    return [
        box(low, high, materials[rng.integers(len(materials))], int(rng.integers(1000)))
        for low, high in sides
    ]


def roof(plan: FloorPlan) -> Solid:
    """A ceiling whose lower face is the top of the volume."""
    (x0, y0), (x1, y1), z = (
        plan.lower[:2] - WALL,
        plan.upper[:2] + WALL,
        plan.upper[2],
    )
    return box((x0, y0, z), (x1, y1, z + 0.2), "ceiling", 0)


def signs_in(walls: list[Solid], aside: int, ahead: int, rng: np.random.Generator) -> list[Solid]:
    """Signs on the inner faces of the `walls` of a hall: up to `aside` on each of those along it,
    up to `ahead` on each of those at its ends."""
    faces, numbers = (3, 2, 1, 0), (aside, aside, ahead, ahead)
    return [
        sign
        for wall, face, number in zip(walls, faces, numbers, strict=True)
        for sign in signs_on(wall, face, number, rng)
    ]


def signs_on(wall: Solid, face: int, number: int, rng: np.random.Generator) -> list[Solid]:
    """Screws up to `number` signs, 2 cm thick, at heights of 1 to 3.4 m to one upright side of an
    upright box: face 0 is -x, 1 +x, 2 -y, 3 +y."""
    assert isinstance(wall.shape, Box)
    half, p = np.asarray(wall.shape.size) / 2, wall.shape.X_WO.translation()
    k, sign = face // 2, 2 * (face % 2) - 1
    along = 1 - k
    room = half[along] - SIGN[0] / 2 - 0.1
    bottom, top = p[2] - half[2], p[2] + half[2]
    lowest, highest = max(bottom + 0.2, 1.0), min(top - 0.2, 4.0) - SIGN[1]
    if room <= 0 or highest < lowest:
        return []
    places = (np.arange(number) + rng.uniform(0.2, 0.8, number)) / number * 2 * room - room
    signs = []
    for place in places:
        low = rng.uniform(lowest, highest)
        center, size = p.copy(), np.full(3, 0.02)
        center[k] += sign * (half[k] + 0.01)
        center[along] += place
        center[2] = low + SIGN[1] / 2
        size[along], size[2] = SIGN
        signs.append(box(center - size / 2, center + size / 2, "signage", int(rng.integers(1000))))
    return signs


def daylight(rng: np.random.Generator) -> tuple[Daylight, Callable[[Esdf], Illumination]]:
    """An hour of the day, and its light with the shadows of a distance field."""
    hour = Daylight.sample(rng)
    return hour, lambda esdf: Sunlight(hour, esdf)


def lamplight(plan: FloorPlan, rng: np.random.Generator) -> Callable[[Esdf], Illumination]:
    """Lamps under the roof, about 4 m apart."""
    lower, upper = plan.lower, plan.upper
    n = np.maximum(np.round((upper - lower)[:2] / 4.0).astype(int), 1)
    i, j = np.meshgrid(np.arange(n[0]), np.arange(n[1]), indexing="ij")
    at = lower[:2] + (np.stack([i, j], axis=-1).reshape(-1, 2) + 0.5) * (upper - lower)[:2] / n
    warmth = rng.uniform(-0.5, 1.0)
    tint = np.array([1.0, 0.96 - 0.05 * warmth, 0.92 - 0.2 * warmth]) * rng.uniform(0.8, 1.15)
    lamps = np.column_stack([at, np.full(len(at), upper[2])])
    return lambda esdf: Lamplight(lamps, tint, esdf)


def start_and_goal(
    plan: FloorPlan, rng: np.random.Generator, heights: tuple[float, float] = (1.2, 2.4)
) -> tuple[NDArray, NDArray]:
    """Draws a start (3,) and a goal (3,) [m] at the two ends of the volume along x, at `heights`
    [m] between the two."""
    lower, upper = plan.lower, plan.upper
    aside = min(0.3 * (upper - lower)[1], (upper - lower)[1] / 2 - INSET)
    y, z = (lower + upper)[1] / 2 + rng.uniform(-aside, aside, 2), rng.uniform(*heights, 2)
    return (
        np.array([lower[0] + INSET, y[0], z[0]]),
        np.array([upper[0] - INSET, y[1], z[1]]),
    )


def clear_of(shape: Shape, points: list[NDArray], clearance: float) -> bool:
    """Whether all `points` (3,) [m] are at least `clearance` [m] from a shape."""
    return bool((ShapeUnion.of([shape]).distance(points) >= clearance).all())


def check_positive(config: object, *names: str) -> None:
    """Raises ValueError for a field of `config` that is not positive and finite, or above 200."""
    for name in names:
        value = getattr(config, name)
        if not 0 < value <= 200:
            raise ValueError(f"{name} = {value} must be more than 0, at most 200")


def check_ground(config: Any) -> None:
    """Raises ValueError for a `config` whose world would take more memory and time than anybody has
    in mind, by its length, width, height and voxel size [m]."""
    area = config.length * config.width
    if not area <= MAX_GROUND:
        raise ValueError(
            f"length = {config.length:g} m times width = {config.width:g} m is {area:.3g} m² of "
            f"ground; it must be at most {MAX_GROUND:g} m²"
        )
    if not config.height <= MAX_HEIGHT:
        raise ValueError(f"height = {config.height:g} m must be at most {MAX_HEIGHT:g} m")
    upper = np.array([config.length, config.width, config.height])
    try:
        grid_shape(np.zeros(3), upper, config.voxel_size)
    except ValueError as error:
        raise ValueError(f"voxel_size = {config.voxel_size:g} m does not fit: {error}") from None


def check_count(config: object, *names: str) -> None:
    """Raises ValueError for a field of `config` that is not 0 to 1000."""
    for name in names:
        if not 0 <= getattr(config, name) <= 1000:
            raise ValueError(f"{name} = {getattr(config, name)} must be 0 to 1000")


def check_range(config: object, low: str, high: str) -> None:
    """Raises ValueError for fields of `config` that are not positive, or more than 100, or of which
    `low` is above `high`."""
    least, most = getattr(config, low), getattr(config, high)
    if not 0 < least <= most <= 100:
        raise ValueError(f"{low} = {least} and {high} = {most} m must be positive and in order")


def check_size(config: object, what: str, length: float, width: float, height: float) -> None:
    """Raises ValueError for a `config` whose length, width or height [m] is less than that."""
    size = [getattr(config, name) for name in ("length", "width", "height")]
    if np.less(size, (length, width, height)).any():
        raise ValueError(
            f"a {what} of {size[0]:g} x {size[1]:g} x {size[2]:g} m is too small; at least "
            f"{length:g} x {width:g} x {height:g} m are needed"
        )


_TRIES = 24
"""Candidates around each point before it is given up, as Bridson (2007) has it."""


def poisson_disk(
    lower: ArrayLike, upper: ArrayLike, spacing: float, rng: np.random.Generator
) -> NDArray[np.float64]:
    """Fills the rectangle [lower, upper] with points no two of which are closer than `spacing`.

    Bridson's algorithm: new points are drawn from the ring of 1 to 2 spacings about old ones and
    kept when no point is too close, looked up on a grid of cells that hold one point at most.

    Args:
        lower, upper: (2,) [m].
        spacing: [m], least distance of two points.

    Returns:
        Points (N, 2) [m].
    """
    lower, upper = np.asarray(lower, dtype=np.float64), np.asarray(upper, dtype=np.float64)
    cell = spacing / np.sqrt(2)
    grid = np.full((*(np.floor((upper - lower) / cell).astype(int) + 5), 2), np.inf)

    def index(p):  # two cells of padding on every side
        i, j = ((p - lower) / cell).astype(int) + 2
        return i, j

    first = rng.uniform(lower, upper)
    grid[index(first)] = first
    points, active = [first], [first]
    while active:
        k = int(rng.integers(len(active)))
        angle = rng.uniform(0, 2 * np.pi, _TRIES)
        radius = spacing * np.sqrt(rng.uniform(1, 4, _TRIES))
        ring = active[k] + radius[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
        for p in ring[((ring >= lower) & (ring <= upper)).all(axis=1)]:
            i, j = index(p)
            near = grid[i - 2 : i + 3, j - 2 : j + 3]
            if (np.square(near - p).sum(axis=-1) >= spacing**2).all():
                grid[i, j] = p
                points.append(p)
                active.append(p)
                break
        else:
            active[k] = active[-1]
            active.pop()
    return np.array(points)
