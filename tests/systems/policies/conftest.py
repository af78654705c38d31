import numpy as np
import pytest
from pydrake.math import RigidTransform

from splatpilot.systems.collision.esdf import Esdf
from splatpilot.systems.collision.esdf_build import esdf_from_distance_field, esdf_from_occupancy
from splatpilot.systems.collision.shapes import AnalyticDistanceField, Box, Cylinder
from splatpilot.systems.policies.time_of_arrival import TimeOfArrival, time_of_arrival

VOXEL_SIZE = 0.2


def box(lower, upper) -> Box:
    """A solid from one corner to the opposite one, (3,) [m] each."""
    lower, upper = np.array(lower, dtype=float), np.array(upper, dtype=float)
    return Box(RigidTransform((lower + upper) / 2), upper - lower)


def field_of(shapes, size) -> Esdf:
    """The conservative field of shapes in the box from the origin to `size` (3,) [m]."""
    world = AnalyticDistanceField(shapes, np.zeros(3), np.array(size, dtype=float))
    return esdf_from_distance_field(world, VOXEL_SIZE).conservative()


@pytest.fixture(scope="session")
def empty() -> Esdf:
    """16 x 8 x 6 m without obstacles."""
    shape = (80, 40, 30)
    far, free = np.full(shape, 50.0, np.float32), np.zeros(shape, np.uint8)
    return Esdf(far, free, np.zeros(3), VOXEL_SIZE).conservative()


@pytest.fixture(scope="session")
def pillar() -> Esdf:
    """16 x 8 x 6 m with a pillar of radius 0.4 m at (6, 4)."""
    return field_of([Cylinder([6, 4, -1], [6, 4, 7], 0.4)], [16.0, 8.0, 6.0])


@pytest.fixture(scope="session")
def pillar_toa(pillar) -> TimeOfArrival:
    """Times of arrival behind the pillar, at (14, 4, 3)."""
    return time_of_arrival(pillar, np.array([14.0, 4.0, 3.0]))


@pytest.fixture(scope="session")
def half_wall() -> Esdf:
    """12 x 10 x 4 m with a wall at 6 <= x <= 6.4 from y = 0 to y = 6."""
    return field_of([box([6, -1, -1], [6.4, 6, 5])], [12.0, 10.0, 4.0])


@pytest.fixture(scope="session")
def closed_wall() -> Esdf:
    """12 x 10 x 4 m cut in two by a wall at 6 <= x <= 6.4."""
    return field_of([box([6, -1, -1], [6.4, 11, 5])], [12.0, 10.0, 4.0])


@pytest.fixture(scope="session")
def u_trap() -> Esdf:
    """14 x 10 x 4 m with a U of walls open toward -x, inside 4 <= x <= 8, 2 <= y <= 8."""
    walls = [
        box([8, 1.6, -1], [8.4, 8.4, 5]),
        box([4, 1.6, -1], [8.4, 2, 5]),
        box([4, 8, -1], [8.4, 8.4, 5]),
    ]
    return field_of(walls, [14.0, 10.0, 4.0])


@pytest.fixture(scope="session")
def narrow_bend() -> Esdf:
    """6 x 4 x 1.6 m, voxels of 0.05 m: a duct 0.9 m wide from (1, 1) in an S to (4.2, 2.6)."""
    occupied = np.ones((120, 80, 32), dtype=bool)
    for x, y in ((slice(11, 61), slice(11, 29)), (slice(43, 61), slice(11, 61))):
        occupied[x, y, 3:-3] = False
    occupied[43:93, 43:61, 3:-3] = False
    return esdf_from_occupancy(occupied, np.zeros_like(occupied), np.zeros(3), 0.05).conservative()
