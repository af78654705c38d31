"""What lies between a policy and the world."""

import numpy as np

from splatpilot.diagrams.flight import fly
from splatpilot.diagrams.flight_diagram import BuildFlightDiagram
from splatpilot.diagrams.policies import policy_named
from splatpilot.diagrams.scenario import Scenario
from splatpilot.systems.sensing.observation_noise import ObservationNoise


def states(world, **noise) -> np.ndarray:
    scenario = Scenario(
        timeout=1.5, policy=policy_named("reactive"), observation=ObservationNoise(**noise)
    )
    return fly(BuildFlightDiagram(scenario, world, camera=False), scenario, world).states


def test_noise_and_latency_reach_the_policy_and_repeat(post_world):
    """Depth noise and latency each change a flight that sees, the same way every time; colour noise
    does not concern a policy of depth.
    """
    clean = states(post_world)
    for noise in ({"depth_multiplicative": 0.2}, {"latency": 0.2}):
        first, second = states(post_world, **noise), states(post_world, **noise)
        np.testing.assert_array_equal(first, second)
        assert np.any(first != clean)
    np.testing.assert_array_equal(states(post_world, color_noise=0.2), clean)


def test_diagram_has_only_what_the_scenario_asks_for(post_world):
    """Noise and delay are systems of the diagram where asked for, and nowhere else."""
    scenario = Scenario(policy=policy_named("reactive"))
    diagram = BuildFlightDiagram(scenario, post_world, camera=False)
    names = {"depth_noise", "color_noise", "delayed_pose"}
    assert not [name for name in names if diagram.HasSubsystemNamed(name)]
    scenario.observation = ObservationNoise(depth_dropout=0.1, color_noise=0.1, latency=0.05)
    diagram = BuildFlightDiagram(scenario, post_world, camera=False)
    assert {n for n in names if diagram.HasSubsystemNamed(n)} == {"depth_noise", "delayed_pose"}
