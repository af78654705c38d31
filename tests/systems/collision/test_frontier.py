import numpy as np
import pytest
from pydrake.math import RigidTransform, RollPitchYaw

from splatpilot.systems.collision.distance_field import FieldState
from splatpilot.systems.collision.esdf import Esdf
from splatpilot.systems.collision.esdf_build import esdf_from_occupancy
from splatpilot.systems.collision.observations import (
    frontier_faces,
    hidden_frontier,
    reachable_space,
    with_obstacles,
)

K = np.array([[40.0, 0.0, 40.0], [0.0, 40.0, 30.0], [0.0, 0.0, 1.0]])


def half_seen_room(closet: bool = False) -> Esdf:
    """A room of 4 x 2 x 2 m with walls of 0.2 m, in voxels of 0.1 m from the origin. The last 1.5 m
    along x are unknown, except for a closet of 0.4 m behind a wall."""
    occupied = np.ones((44, 24, 24), bool)
    occupied[2:42, 2:22, 2:22] = False
    unknown = np.zeros_like(occupied)
    unknown[27:] = ~occupied[27:]
    if closet:
        occupied[34:38, 10:14, 10:14] = unknown[34:38, 10:14, 10:14] = False
    return esdf_from_occupancy(occupied, unknown, np.zeros(3), 0.1)


def test_reachable_space_holds_the_vehicle():
    field = half_seen_room(closet=True)
    free = field.states == FieldState.FREE
    expected = free.copy()
    expected[27:] = False
    np.testing.assert_array_equal(reachable_space(field, 0.35), expected)
    assert not reachable_space(field, 1.1).any()
    assert free[27:].any()


def test_obstacles_begin_two_voxels_behind_seen_space():
    field = half_seen_room()
    reachable = reachable_space(field, 0.35)
    hidden, before, _ = hidden_frontier(field, reachable, [], K, [])
    assert set(np.argwhere(hidden)[:, 0]) == {28}
    assert hidden[28, 2:22, 2:22].all()
    centers, normals = frontier_faces(before, hidden)
    assert len(centers) == 20 * 20
    np.testing.assert_array_equal(centers[:, 0], 28.0)
    np.testing.assert_array_equal(normals, np.tile([-1.0, 0.0, 0.0], (400, 1)))

    closed = with_obstacles(field, hidden)
    p_WQ = np.array([[2.0, 1.2, 1.2], [2.5, 1.0, 1.2], [0.5, 1.2, 1.2], [2.65, 0.3, 1.2]])
    np.testing.assert_allclose(closed.distance(p_WQ), [0.8, 0.3, 0.3, 0.1], atol=0.01)
    assert closed.query([2.85, 1.2, 1.2]).state == FieldState.OCCUPIED
    free = field.states == FieldState.FREE
    np.testing.assert_allclose(
        closed.conservative().distances[free], field.conservative().distances[free], atol=1e-6
    )


@pytest.mark.parametrize(("seen", "surface"), [(np.inf, False), (1000.0, False), (50.0, True)])
def test_space_before_the_sky_and_far_surfaces_stays_open(seen, surface):
    field = half_seen_room()
    R_WC = RollPitchYaw(0.0, np.pi / 2, 0.0).ToRotationMatrix()  # x of the image is -z
    X_WC = RigidTransform(R_WC, [0.8, 1.2, 1.2])
    depth = np.zeros((60, 80))
    depth[:, :40] = seen
    hidden, _, before_surface = hidden_frontier(
        field, reachable_space(field, 0.35), [depth], K, [X_WC]
    )
    assert before_surface is surface
    assert hidden[28, 2:22, 2:11].all()
    assert not hidden[28, 2:22, 13:].any()
