"""Building blocks of procedural worlds: volumes, boxes, halls, signs, daylight, lamps."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydrake.math import RigidTransform, RotationMatrix

from splatpilot.diagrams.worlds.solids.patterns import SIGN
from splatpilot.diagrams.worlds.solids.solid import Solid, WorldSpec
from splatpilot.diagrams.worlds.solids.surfaces import FloorPlan
from splatpilot.diagrams.worlds.solids.textures import Daylight, Illumination, Lamplight, Sunlight
from splatpilot.systems.collision.esdf import Esdf
from splatpilot.systems.collision.esdf_build import grid_shape
from splatpilot.systems.collision.shapes import Box, HalfSpace, Shape, ShapeUnion
from splatpilot.systems.common.validation import Config, bounded, require, require_field
from splatpilot.systems.splats.scene import GaussianScene
from splatpilot.systems.vehicle.quadrotor import VEHICLE_RADIUS

WALL = 0.3  # [m], thickness of walls
INSET = 1.5  # [m], distance of start and goal from the ends of the volume

# [m], obstacle-free radius about start and goal, also among thin or reconstructed obstacles.
CLEARING, TIGHT_CLEARING = 1.0, 0.9

MAX_GROUND, MAX_HEIGHT = 20_000.0, 100.0  # [m²] and [m], of generated worlds: 20 million Gaussians
PASSAGE = 2 * VEHICLE_RADIUS + 0.1  # [m], minimum width of gaps for the vehicle
MAX_VOXELS = 2e7  # of the distance field of a world on disk: some 90 bytes each


def box(lower: ArrayLike, upper: ArrayLike, material: str, seed: int) -> Solid:
    """Returns an upright box between two corners (3,) [m]."""
    lower, upper = np.asarray(lower, float), np.asarray(upper, float)
    return Solid(Box(RigidTransform((lower + upper) / 2), upper - lower), material, seed)


def rotated_box(
    p_W: ArrayLike, R_W: RotationMatrix, size: ArrayLike, material: str, seed: int
) -> Solid:
    """Returns a box about p_W (3,) [m] with edges `size` (3,) [m] along the axes of R_W."""
    return Solid(Box(RigidTransform(R_W, np.asarray(p_W, float)), size), material, seed)


def ground(material: str, seed: int = 0) -> Solid:
    """Returns the ground z = 0."""
    return Solid(HalfSpace(np.array([0.0, 0.0, 1.0]), 0.0), material, seed)


def hall(plan: FloorPlan, materials: list[str], rng: np.random.Generator) -> list[Solid]:
    """Draws walls around a volume, of the `materials`: at -y, +y, -x and +x."""
    (x0, y0, _), (x1, y1, z1) = plan.lower, plan.upper
    sides = (
        ((x0 - WALL, y0 - WALL, 0), (x1 + WALL, y0, z1)),
        ((x0 - WALL, y1, 0), (x1 + WALL, y1 + WALL, z1)),
        ((x0 - WALL, y0, 0), (x0, y1, z1)),
        ((x1, y0, 0), (x1 + WALL, y1, z1)),
    )
    return [box(low, high, *draw_paint(materials, rng)) for low, high in sides]


def draw_paint(materials: list[str], rng: np.random.Generator) -> tuple[str, int]:
    """Draws material and seed of a solid."""
    return materials[rng.integers(len(materials))], int(rng.integers(1000))


def roof(plan: FloorPlan) -> Solid:
    """Returns a ceiling on top of a volume."""
    lower, upper, z = plan.lower[:2] - WALL, plan.upper[:2] + WALL, plan.upper[2]
    return box((*lower, z), (*upper, z + 0.2), "ceiling", 0)


def signs_in(walls: list[Solid], aside: int, ahead: int, rng: np.random.Generator) -> list[Solid]:
    """Draws signs on the inner faces of a hall: up to `aside` on each side, `ahead` at each end."""
    faces, counts = (3, 2, 1, 0), (aside, aside, ahead, ahead)
    return [
        sign
        for wall, face, count in zip(walls, faces, counts, strict=True)
        for sign in signs_on(wall, face, count, rng)
    ]


def signs_on(wall: Solid, face: int, count: int, rng: np.random.Generator) -> list[Solid]:
    """Draws up to `count` signs on an upright box's face: -x, +x, -y or +y, by index."""
    assert isinstance(wall.shape, Box)
    half, p = np.asarray(wall.shape.size) / 2, wall.shape.X_WO.translation()
    k, sign = face // 2, 2 * (face % 2) - 1
    along = 1 - k
    reach = half[along] - SIGN[0] / 2 - 0.1
    bottom, top = p[2] - half[2], p[2] + half[2]
    lowest, highest = max(bottom + 0.2, 1.0), min(top - 0.2, 4.0) - SIGN[1]
    if reach <= 0 or highest < lowest:
        return []
    offsets = (np.arange(count) + rng.uniform(0.2, 0.8, count)) / count * 2 * reach - reach
    signs, size = [], np.full(3, 0.02)
    size[along], size[2] = SIGN
    for offset in offsets:
        center = p.copy()
        center[k] += sign * (half[k] + 0.01)
        center[along] += offset
        center[2] = rng.uniform(lowest, highest) + SIGN[1] / 2
        signs.append(box(center - size / 2, center + size / 2, "signage", int(rng.integers(1000))))
    return signs


def daylight(rng: np.random.Generator) -> tuple[Daylight, Callable[[Esdf], Illumination]]:
    """Draws an hour of the day; returns it and a function from an ESDF to its light."""
    hour = Daylight.sample(rng)
    return hour, lambda esdf: Sunlight(hour, esdf)


def lamplight(plan: FloorPlan, rng: np.random.Generator) -> Callable[[Esdf], Illumination]:
    """Draws lamps under the roof, about 4 m apart; returns a function from an ESDF to the light."""
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
    """Draws a start (3,) and a goal (3,) [m] at the ends along x, within `heights` [m]."""
    lower, upper = plan.lower, plan.upper
    aside = min(0.3 * (upper - lower)[1], (upper - lower)[1] / 2 - INSET)
    y, z = (lower + upper)[1] / 2 + rng.uniform(-aside, aside, 2), rng.uniform(*heights, 2)
    x = lower[0] + INSET, upper[0] - INSET
    return np.array([x[0], y[0], z[0]]), np.array([x[1], y[1], z[1]])


def has_clearance(shape: Shape, p_W: ArrayLike, clearance: float) -> bool:
    """Checks that all points (N, 3) [m] are at least `clearance` [m] from a shape."""
    return bool((ShapeUnion.of([shape]).distance(p_W) >= clearance).all())


def suitable_voxel(lower_W: ArrayLike, upper_W: ArrayLike) -> float:
    """Returns a size of voxels [m] for a box: 0.1 m, or more for `MAX_VOXELS`."""
    return max(0.1, float(np.cbrt(np.prod(np.subtract(upper_W, lower_W)) / MAX_VOXELS)))


@dataclass
class VolumeConfig(Config):
    """The flyable volume of a generated world."""

    length: float = bounded(36.0, "(0, 200] m")  # [m] along x: from 0 to length
    width: float = bounded(16.0, "(0, 200] m")  # [m] along y, centered on 0
    height: float = bounded(6.0, f"(0, {MAX_HEIGHT:g}] m")  # [m] along z
    voxel_size: float = bounded(0.15, "(0, 200] m")  # [m] of the distance grid

    @property
    def plan(self) -> FloorPlan:
        return FloorPlan.of_size(self.length, self.width, self.height)

    def check(self) -> None:
        area = self.length * self.width
        require(area <= MAX_GROUND, "length * width", f"at most {MAX_GROUND:g} m^2", f"{area:.3g}")
        grid_shape(self.plan.lower, self.plan.upper, self.voxel_size)


def require_order(config: object, low: str, high: str) -> None:
    """Checks that a field does not exceed another one."""
    limit = getattr(config, high)
    require_field(config, low, getattr(config, low) <= limit, f"at most {high} = {limit}")


def volume_spec(
    name: str,
    config: VolumeConfig,
    seed: int,
    solids: list[Solid],
    ends: tuple[NDArray, NDArray],
    light: Callable[[Esdf], Illumination],
    surroundings: Callable[[], list[GaussianScene]] = list,
) -> WorldSpec:
    """Returns the specification of a world that fills the volume of `config`."""
    box = config.plan.lower, config.plan.upper
    options = {"voxel_size": config.voxel_size, "surroundings": surroundings}
    return WorldSpec(name, *box, solids, *ends, light, seed, **options)


_TRIES = 24  # candidates around each point


def poisson_disk(
    lower: ArrayLike, upper: ArrayLike, spacing: float, rng: np.random.Generator
) -> NDArray[np.float64]:
    """Fills the rectangle [lower, upper], (2,) [m], with points (N, 2) at least `spacing` apart.
    Bridson's algorithm (2007), with a grid of cells that hold at most one point."""
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
