import numpy as np
import pytest
from numpy.polynomial import Polynomial
from pydrake.math import RollPitchYaw

from splatpilot.systems.policies.motion_primitives import (
    level_acceleration,
    quintic_basis,
    rotation_to,
    select_distinct,
)
from splatpilot.systems.vehicle.quadrotor import QuadrotorParams


@pytest.mark.parametrize("derivative", [0, 1, 2])
def test_quintics_meet_their_boundary_states(derivative):
    basis = quintic_basis(np.array([0.0, 1.7]), 1.7, derivative)
    expected = np.zeros((2, 6))
    expected[0, derivative] = expected[1, 3 + derivative] = 1.0
    np.testing.assert_allclose(basis, expected, atol=1e-13)


@pytest.mark.parametrize("derivative", [0, 1, 2, 3])
def test_quintics_equal_the_polynomial(derivative):
    polynomial = Polynomial([0.3, -1.0, 2.0, 0.7, -0.4, 0.09])
    times, horizon = np.linspace(0.0, 2.0, 21), 2.0
    boundary = [polynomial.deriv(order)(t) for t in (0.0, horizon) for order in range(3)]
    np.testing.assert_allclose(
        quintic_basis(times, horizon, derivative) @ boundary,
        polynomial.deriv(derivative)(times) if derivative else polynomial(times),
        atol=1e-11,
    )


@pytest.mark.parametrize("direction", [[3, 0, 0], [-1, 2, 0.5], [0, 0, 2], [0, 0, -1], [0, 0, 0]])
def test_lattice_frame(direction):
    direction = np.array(direction, dtype=float)
    R_WL = rotation_to(direction)
    np.testing.assert_allclose(R_WL.T @ R_WL, np.eye(3), atol=1e-14)
    assert np.linalg.det(R_WL) == pytest.approx(1.0)
    np.testing.assert_allclose(R_WL[:, 0] * np.linalg.norm(direction), direction, atol=1e-14)
    assert R_WL[2, 1] == 0.0


def test_selection_falls_back_to_the_most_distant():
    positions = np.array([0.0, 0.01, 0.02, 1.0, 0.03])[:, None, None] * np.ones((5, 4, 3))
    costs = np.array([1.0, 2.0, 3.0, 9.0, 4.0])
    np.testing.assert_array_equal(select_distinct(positions, costs, 3, 0.35), [0, 4, 3])
    np.testing.assert_array_equal(select_distinct(positions, costs, 5, 0.35), [0, 1, 2, 4, 3])
    alike = np.zeros((3, 4, 3))
    np.testing.assert_array_equal(select_distinct(alike, costs[:3], 3, 0.35), [0, 1, 2])


def test_level_acceleration():
    params = QuadrotorParams(drag=0.4, gravity=3.7)
    R_WB = RollPitchYaw(0.0, 0.3, 1.0).ToRotationMatrix().matrix()
    expected = 3.7 * np.tan(0.3) * np.array([np.cos(1.0), np.sin(1.0), 0.0])
    np.testing.assert_allclose(level_acceleration(R_WB, np.zeros(3), params), expected, atol=1e-12)
    v_WB = np.array([*expected[:2] / 0.4, -3.0])
    np.testing.assert_allclose(level_acceleration(R_WB, v_WB, params), 0.0, atol=1e-12)
