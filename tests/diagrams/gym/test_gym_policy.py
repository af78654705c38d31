import numpy as np
import pytest
from pydrake.systems.analysis import ApplySimulatorConfig, Simulator

from splatpilot.diagrams.flight.flight_diagram import BuildFlightDiagram
from splatpilot.diagrams.flight.scenario import Scenario
from splatpilot.diagrams.gym.flight_env import FlightEnv
from splatpilot.diagrams.gym.gym_policy import GymPolicy
from splatpilot.diagrams.gym.spaces import FlightEnvConfig
from splatpilot.diagrams.worlds.moving_spheres import MovingSphere

BALL = MovingSphere(radius=0.3, waypoints=[[4.0, 1.5, 2.0], [2.0, 1.5, 2.0]])


@pytest.mark.parametrize(
    ("observation", "action", "fields"),
    [
        (["state", "goal", "obstacle"], "velocity", {}),
        ("obstacle", "velocity", {"moving": {"ball": BALL}}),
        (["depth", "goal"], "acceleration", {}),
        (["rgb", "depth_m", "state"], "waypoint", {}),
        ("state", "command", {"decision_delay": [0.06, 0.06]}),
        ("state", "waypoint", {"decision_delay": [0.06, 0.06]}),
    ],
)
def test_its_flight_is_that_of_the_environment(observation, action, fields, post_world):
    scenario = Scenario(timeout=2.0, **fields)
    size = 4 if action == "command" else 3
    env = FlightEnv(scenario, world=post_world, observation=observation, action=action)

    def predict(seen):
        values = [seen] if isinstance(observation, str) else list(seen.values())
        assert env.observation_space.contains(seen)
        mean = np.mean([np.asarray(value, float).mean() / 255.0 for value in values])
        return 0.3 * np.sin(mean * np.arange(1.0, size + 1.0))

    seen, _ = env.reset(seed=0)
    policy = GymPolicy(predict, env.config, post_world)
    diagram = BuildFlightDiagram(scenario, post_world, policy=policy, camera=False)
    simulator = Simulator(diagram)
    ApplySimulatorConfig(scenario.simulator, simulator)
    context = simulator.get_mutable_context()
    context.SetContinuousState(env._vehicles.states[0])
    for step in range(8):
        seen = env.step(predict(seen))[0]
        simulator.AdvanceTo(0.1 * (step + 1))
        state = diagram.GetOutputPort("state").Eval(context)
        np.testing.assert_allclose(state, env._vehicles.states[0], atol=1e-6)


@pytest.mark.parametrize(
    ("observation", "message"),
    [
        ("obstacle", "world must be that of the flight"),
        (["imu_gyroscope"], "observation must be one of state"),
        ("state", "action must be in"),
    ],
)
def test_invalid_arguments_are_errors(observation, message):
    with pytest.raises(ValueError, match=message):
        policy = GymPolicy(lambda _: np.full(3, 2.0), FlightEnvConfig(observation=observation))
        context = policy.CreateDefaultContext()
        for name, size in (("state", 13), ("goal", 3)):
            policy.GetInputPort(name).FixValue(context, np.full(size, 0.5))
        Simulator(policy, context).AdvanceTo(0.0)
