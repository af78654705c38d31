import numpy as np
import pytest

from splatpilot.systems.vehicle.airframe import QuadrotorAirframe
from splatpilot.systems.vehicle.quadrotor import QuadrotorPlant, hover_state
from splatpilot.systems.vehicle.vehicles import Crazyflie21Brushless, Kingfisher, Px4Sih
from tests.systems.vehicle.responses import evaluate, fly

START = hover_state([1.0, -2.0, 3.0], yaw=0.7)
KINGFISHER = Kingfisher(ground_effect=0.3, battery_sag=0.2, battery_endurance=200.0)
COMMANDS = np.random.default_rng(4).uniform([6.0, -3.0, -3.0, -2.0], [15.0, 3.0, 3.0, 2.0], (10, 4))


@pytest.mark.parametrize("params", [KINGFISHER, Px4Sih(), Crazyflie21Brushless()])
def test_rigid_body_with_propellers_flies_as_the_equations_of_the_rotors(params):
    inputs = {"wind": [2.0, -1.0, 0.5], "disturbance": [0.3, 0.2, -0.4]}
    expected = fly(QuadrotorPlant(params, START), COMMANDS, 0.005, **inputs)
    found = fly(QuadrotorAirframe(params, START), COMMANDS, 0.005, **inputs)
    # Both are within the error of integration, which falls with the step.
    error = np.abs(fly(QuadrotorPlant(params, START), COMMANDS, **inputs) - expected).max()
    assert np.linalg.norm(expected[-1, :3] - START[:3]) > 1.0
    np.testing.assert_allclose(np.abs(found[:, 6:10]), np.abs(expected[:, 6:10]), atol=1e-6)
    rest = [*range(6), 10, 11, 12]
    np.testing.assert_allclose(found[:, rest], expected[:, rest], atol=10.0 * error + 1e-9)


def test_acceleration_is_that_of_the_plant():
    inputs = {"command": [12.0, 0.0, 0.0, 0.0], "wind": [3.0, 0.0, 0.0]}
    plants = QuadrotorPlant(KINGFISHER, START), QuadrotorAirframe(KINGFISHER, START)
    expected, found = (evaluate(plant, "acceleration", **inputs) for plant in plants)
    np.testing.assert_allclose(found, expected, atol=1e-12)
