import numpy as np
import pytest
from pydrake.systems.analysis import Simulator

from splatpilot.systems.policies.observations import target_velocity
from splatpilot.systems.policies.straight import Straight, StraightConfig
from splatpilot.systems.policies.velocity import (
    MAX_ACCELERATION,
    RESPONSE_TIME,
    SLOWING_TIME,
    tracking_acceleration,
)
from splatpilot.systems.vehicle.quadrotor import hover_state


def test_velocity_points_to_the_goal_and_falls_near_it():
    p_WG = np.array([3.0, -4.0, 2.0])
    far = target_velocity(np.array([0.0, 0.0, 2.0]), p_WG, 2.0, SLOWING_TIME)
    np.testing.assert_allclose(far, [1.2, -1.6, 0.0])
    near = target_velocity(p_WG - [0.3, 0.0, 0.0], p_WG, 2.0, SLOWING_TIME)
    np.testing.assert_allclose(near, [0.4, 0.0, 0.0])
    np.testing.assert_array_equal(target_velocity(p_WG, p_WG, 2.0, SLOWING_TIME), np.zeros(3))


def test_tracking_is_exponential_and_limited():
    v, wanted, step = np.zeros(3), np.array([0.5, 0.0, 0.2]), 1e-4
    for _ in range(round(RESPONSE_TIME / step)):
        v = v + step * tracking_acceleration(v, wanted)
    np.testing.assert_allclose(v, wanted * (1 - np.exp(-1)), rtol=1e-3)
    large = tracking_acceleration(np.zeros(3), np.array([0.0, -10.0, 0.0]))
    np.testing.assert_allclose(large, [0.0, -MAX_ACCELERATION, 0.0])


def test_system_decides_by_state_and_goal():
    policy = Straight(StraightConfig(speed=3.0))
    context = policy.CreateDefaultContext()
    policy.GetInputPort("state").FixValue(context, hover_state([1.0, 2.0, 3.0]))
    policy.GetInputPort("goal").FixValue(context, [11.0, 2.0, 3.0])
    port = policy.GetOutputPort("acceleration")
    np.testing.assert_array_equal(port.Eval(context), np.zeros(3))
    simulator = Simulator(policy, context)
    simulator.AdvanceTo(0.01)
    np.testing.assert_allclose(port.Eval(simulator.get_context()), [MAX_ACCELERATION, 0, 0])


@pytest.mark.parametrize(("field", "value"), [("speed", 0.0), ("speed", np.nan), ("rate", -1.0)])
def test_bad_config_is_named(field, value):
    with pytest.raises(ValueError, match=rf"StraightConfig.{field} .* got {value}"):
        Straight(StraightConfig(**{field: value}))
