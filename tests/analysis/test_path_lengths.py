"""Ways before a wall that closes a volume."""

import numpy as np
import pytest
from pydrake.math import RigidTransform

from splatpilot.analysis.difficulty import SPACING, march, shortest_path
from splatpilot.diagrams.worlds.feasibility import grid_distances
from splatpilot.systems.collision.shapes import AnalyticDistanceField, Box
from splatpilot.systems.vehicle.quadrotor import VEHICLE_RADIUS as R

WALL = Box(RigidTransform([6.0, 0.0, 2.0]), [0.2, 9.0, 8.0])
CLOSED = AnalyticDistanceField([WALL], np.array([0.0, -4, 0]), np.array([12.0, 4, 4]))


def test_no_way_is_an_error():
    """A closed wall leaves none."""
    start, goal = np.array([1.5, 0.1, 2.0]), np.array([10.5, 0.1, 2.0])
    with pytest.raises(ValueError, match="no path"):
        shortest_path(CLOSED, grid_distances(CLOSED, SPACING), start, goal)


def test_march_stops_at_walls_and_bounds():
    """A ball stops at its radius before a wall; its center at the bounds, whichever are met first;
    nothing flies on longer.
    """
    x = np.array([[1.0, 0.0, 0.0]])
    start = np.array([[1.0, 0.0, 2.0]])
    assert march(CLOSED, start, x, R, 99.0) == pytest.approx([4.9 - R], abs=0.011)
    assert march(CLOSED, start, -x, 0.0, 99.0) == pytest.approx([1.0], rel=1e-12)
    assert march(CLOSED, start, -x, R, 99.0) == pytest.approx([1.0], rel=1e-12)
    slanted = np.array([[-0.6, 0.8, 0.0], [0.0, 0.6, 0.8], [0.0, 0.0, -1.0]])
    lengths = march(CLOSED, start.repeat(3, axis=0), slanted, 0.0, 99.0)
    assert lengths == pytest.approx([1.0 / 0.6, 2.0 / 0.8, 2.0], rel=1e-12)
    assert march(CLOSED, start, x, R, 2.0) == [2.0]
