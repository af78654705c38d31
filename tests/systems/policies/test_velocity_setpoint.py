"""What autopilots are told that take velocities."""

import numpy as np
import pytest

from splatpilot.systems.policies.velocity_setpoint import VelocitySetpoint
from splatpilot.systems.policies.velocity_tracking import tracking_acceleration

STATE = np.array([1.0, 2, 3, 0.5, -0.5, 0.2, 1, 0, 0, 0, 0, 0, 0])


def setpoint(**inputs) -> np.ndarray:
    system = VelocitySetpoint(lookahead=0.5)
    context = system.CreateDefaultContext()
    for name, value in {"state": STATE, **inputs}.items():
        system.GetInputPort(name).FixValue(context, value)
    return system.velocity_setpoint_output_port().Eval(context)


def test_acceleration_leads_to_the_velocity_that_was_wanted():
    """It undoes `tracking_acceleration`: the velocity that asks for an acceleration is told."""
    wanted = np.array([1.5, 0.5, -0.3])
    acceleration = tracking_acceleration(STATE[3:6], wanted)
    np.testing.assert_allclose(setpoint(acceleration=acceleration)[:3], wanted)


def test_velocity_is_told_as_it_is():
    """A policy's velocity is the setpoint."""
    np.testing.assert_array_equal(setpoint(velocity=np.array([1.0, -2, 3]))[:3], [1, -2, 3])


def test_waypoint_is_reached_in_time():
    """At the velocity to a waypoint the vehicle is there when it is due; the heading goes along."""
    told = setpoint(waypoint=np.array([2.0, 2, 2]), heading=np.array([0.7]))
    np.testing.assert_allclose(told, [2.0, 0.0, -2.0, 0.7])


@pytest.mark.parametrize("decision", ["waypoint", "acceleration"])
def test_heading_is_free_where_the_policy_says_none(decision):
    """Without a heading the setpoint's is not a number."""
    assert np.isnan(setpoint(**{decision: np.zeros(3)})[3])
